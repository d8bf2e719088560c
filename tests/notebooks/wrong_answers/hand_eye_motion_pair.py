"""Wrong answers to `motion_pair` of notebook 04."""

import numpy as np

from wrong_answers import changed


def with_inv(gripper_i, gripper_j, board_i, board_j):
    inv = np.linalg.inv
    A = inv(gripper_j) @ gripper_i
    B = board_j @ inv(board_i)
    return np.stack((A, B))


changed(
    with_inv,
    {
        "inv(gripper_j) -> gripper_j and inv(board_i) -> board_i": "not_inverted",
        "inv(gripper_j) @ gripper_i -> gripper_j @ inv(gripper_i)": "motion_in_base",
        "inv(gripper_j) @ gripper_i -> np.linalg.solve(gripper_i, gripper_j)": "a_exchanged",
        "inv(gripper_j) @ gripper_i -> inv(gripper_i) @ gripper_j "
        "and board_j @ inv(board_i) -> board_i @ inv(board_j)": "both_exchanged",
        "inv(gripper_j) -> gripper_j.I": "raised",
    },
)


def own_inverse(gripper_i, gripper_j, board_i, board_j):
    def undo(T):
        out = np.eye(4)
        out[:3, :3] = T[:3, :3].T
        out[:3, 3] = -T[:3, :3].T @ T[:3, 3]
        return out

    return [undo(gripper_j) @ gripper_i, board_j @ undo(board_i)]


changed(
    own_inverse,
    {
        "out = np.eye(4) -> return T.T": "transposed_pose",
        "-T[:3, :3].T @ T[:3, 3] -> -T[:3, 3]": "translation_not_turned",
        "board_j @ undo(board_i) -> board_i @ undo(board_j)": "b_exchanged",
        "board_j @ undo(board_i) -> undo(board_j) @ board_i": "motion_in_board",
        "undo(gripper_j) @ gripper_i, board_j @ undo(board_i) "
        "-> board_j @ undo(board_i), undo(gripper_j) @ gripper_i": "exchanged",
        "undo(gripper_j) @ gripper_i, board_j @ undo(board_i) "
        "-> undo(gripper_i) @ gripper_j, undo(board_j) @ board_i": "several, first a_exchanged",
        "undo(gripper_j) @ -> undo(gripper_j) * and board_j @ -> board_j *": "elementwise",
        "undo(gripper_j) @ gripper_i -> gripper_i - gripper_j "
        "and board_j @ undo(board_i) -> board_j - board_i": "subtracted",
        ", board_j @ undo(board_i)] -> ][0]": None,
    },
)
