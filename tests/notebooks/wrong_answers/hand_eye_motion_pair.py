"""Wrong answers to `motion_pair` of notebook 04."""

import numpy as np

from wrong_answers import wrong


def _undo(T):
    """The inverse of a pose: right."""
    out = np.eye(4)
    out[:3, :3] = T[:3, :3].T
    out[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return out


@wrong("transposed_pose", "matrix products")
def transpose_for_inverse(gripper_i, gripper_j, board_i, board_j):
    return np.array([gripper_j.T @ gripper_i, board_j @ board_i.T])


@wrong("translation_not_turned", "blocks")
def inverse_with_the_sign_only(gripper_i, gripper_j, board_i, board_j):
    def undo(T):
        out = np.eye(4)
        out[:3, :3] = T[:3, :3].T
        out[:3, 3] = -T[:3, 3]
        return out

    return undo(gripper_j) @ gripper_i, board_j @ undo(board_i)


@wrong("not_inverted", "matrix products")
def plain_products(gripper_i, gripper_j, board_i, board_j):
    return gripper_j @ gripper_i, board_j @ board_i


@wrong("motion_in_base", "np.linalg")
def arm_motion_in_the_base(gripper_i, gripper_j, board_i, board_j):
    A = gripper_j @ np.linalg.inv(gripper_i)
    B = board_j @ np.linalg.inv(board_i)
    return np.stack((A, B))


@wrong("a_exchanged", "np.linalg")
def arm_from_i_to_j(gripper_i, gripper_j, board_i, board_j):
    return np.linalg.solve(gripper_i, gripper_j), board_j @ np.linalg.inv(board_i)


@wrong("b_exchanged", "own inverse")
def camera_from_i_to_j(gripper_i, gripper_j, board_i, board_j):
    return _undo(gripper_j) @ gripper_i, board_i @ _undo(board_j)


@wrong("motion_in_board", "own inverse")
def both_the_same_way(gripper_i, gripper_j, board_i, board_j):
    return [_undo(gripper_j) @ gripper_i, _undo(board_j) @ board_i]


@wrong("both_exchanged", "np.linalg")
def first_minus_second(gripper_i, gripper_j, board_i, board_j):
    inv = np.linalg.inv
    return inv(gripper_i) @ gripper_j, board_i @ inv(board_j)


@wrong("b_first", "own inverse")
def camera_first(gripper_i, gripper_j, board_i, board_j):
    return board_j @ _undo(board_i), _undo(gripper_j) @ gripper_i


@wrong("several, first a_exchanged", "own inverse")
def arm_exchanged_and_board_frame(gripper_i, gripper_j, board_i, board_j):
    return _undo(gripper_i) @ gripper_j, _undo(board_j) @ board_i


@wrong(None, "elementwise")
def star_for_a_product(gripper_i, gripper_j, board_i, board_j):
    return _undo(gripper_j) * gripper_i, board_j * _undo(board_i)


@wrong(None, "differences")
def differences(gripper_i, gripper_j, board_i, board_j):
    return gripper_i - gripper_j, board_j - board_i


@wrong(None, "only one")
def only_A(gripper_i, gripper_j, board_i, board_j):
    return _undo(gripper_j) @ gripper_i


@wrong(None, "attributes", kind="raised")
def inverse_as_an_attribute(gripper_i, gripper_j, board_i, board_j):
    return gripper_j.I @ gripper_i, board_j @ board_i.I
