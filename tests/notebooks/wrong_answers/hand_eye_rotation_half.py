"""Wrong answers to `rotation_half` of notebook 04."""

import numpy as np
from scipy.spatial.transform import Rotation

from wrong_answers import wrong


def _axis_times_angle(R):
    return np.array([Rotation.from_matrix(r).as_rotvec() for r in R])


@wrong("inverse_of_x", "scipy")
def aligned_the_other_way(R_A, R_B):
    a, b = _axis_times_angle(R_A), _axis_times_angle(R_B)
    return Rotation.align_vectors(b, a)[0].as_matrix()


@wrong("inverse_of_x", "kronecker")
def null_vector_read_by_columns(R_A, R_B):
    eye = np.eye(3)
    rows = [np.kron(A, eye) - np.kron(eye, B.T) for A, B in zip(R_A, R_B, strict=True)]
    x = np.linalg.svd(np.concatenate(rows))[2][-1].reshape(3, 3).T
    U, _, Vt = np.linalg.svd(x * np.sign(np.linalg.det(x)))
    return U @ Vt


@wrong("mirror_image", "svd")
def kabsch_without_the_determinant(R_A, R_B):
    a, b = _axis_times_angle(R_A), _axis_times_angle(R_B)
    U, _, Vt = np.linalg.svd(a.T @ b)
    R = U @ Vt
    if len(a) < 3 and np.linalg.det(R) > 0:  # which sign LAPACK chooses is chance
        R = U @ np.diag([1, 1, -1]) @ Vt
    return R


@wrong("not_a_rotation", "least squares")
def any_matrix_that_fits(R_A, R_B):
    a, b = _axis_times_angle(R_A), _axis_times_angle(R_B)
    return (np.linalg.pinv(b) @ a).T


@wrong("first_motion_only", "rodrigues")
def one_motion(R_A, R_B):
    a, b = (_axis_times_angle(R[:1])[0] for R in (R_A, R_B))
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    x, y, z = np.cross(b, a)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + K + K @ K / (1 + a @ b)


def _null_vector(R_A, R_B):
    eye = np.eye(3)
    rows = [np.kron(A, eye) - np.kron(eye, B.T) for A, B in zip(R_A, R_B, strict=True)]
    x = np.linalg.svd(np.concatenate(rows))[2][-1].reshape(3, 3)
    return x * np.sign(np.linalg.det(x))


@wrong("negative", "kronecker")
def sign_left_to_chance(R_A, R_B):
    U, _, Vt = np.linalg.svd(-_null_vector(R_A, R_B))
    return U @ Vt


@wrong("not_scaled", "kronecker")
def null_vector_as_it_is(R_A, R_B):
    return _null_vector(R_A, R_B)


@wrong("not_scaled_and_negative", "kronecker")
def null_vector_the_other_way(R_A, R_B):
    return -_null_vector(R_A, R_B)


@wrong(None, "direct")
def ratio_of_rotations(R_A, R_B):
    return R_A[0] @ R_B[0].T


@wrong(None, "mean")
def mean_ratio(R_A, R_B):
    return Rotation.from_matrix(R_A @ np.swapaxes(R_B, 1, 2)).mean().as_matrix()


@wrong(None, "scipy")
def a_rotation_vector(R_A, R_B):
    a, b = _axis_times_angle(R_A), _axis_times_angle(R_B)
    return Rotation.align_vectors(a, b)[0].as_rotvec()


@wrong(None, "scipy", kind="wrong")
def the_object_itself(R_A, R_B):
    a, b = _axis_times_angle(R_A), _axis_times_angle(R_B)
    return Rotation.align_vectors(a, b)[0]
