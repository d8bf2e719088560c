"""Wrong answers to `motion_pair` of notebook 04."""

import numpy as np


def with_inv(gripper_i, gripper_j, board_i, board_j):
    inv = np.linalg.inv
    A = inv(gripper_j) @ gripper_i
    B = board_j @ inv(board_i)
    return np.stack((A, B))


def own_inverse(gripper_i, gripper_j, board_i, board_j):
    def undo(T):
        out = np.eye(4)
        out[:3, :3] = T[:3, :3].T
        out[:3, 3] = -T[:3, :3].T @ T[:3, 3]
        return out

    return [undo(gripper_j) @ gripper_i, board_j @ undo(board_i)]
