"""Wrong answers to `rotation_half` of notebook 04."""

import numpy as np
from scipy.spatial.transform import Rotation

from wrong_answers import wrong


def _axis_times_angle(R):
    return np.array([Rotation.from_matrix(r).as_rotvec() for r in R])


def by_scipy(R_A, R_B):
    a, b = _axis_times_angle(R_A), _axis_times_angle(R_B)
    return Rotation.align_vectors(a, b)[0].as_matrix()


def kronecker(R_A, R_B):
    eye = np.eye(3)
    rows = [np.kron(A, eye) - np.kron(eye, B.T) for A, B in zip(R_A, R_B, strict=True)]
    x = np.linalg.svd(np.concatenate(rows))[2][-1].reshape(3, 3)
    x = x * np.sign(np.linalg.det(x))
    U, _, Vt = np.linalg.svd(x)
    return U @ Vt


@wrong("mirrored")
def kabsch_without_the_determinant(R_A, R_B):
    a, b = _axis_times_angle(R_A), _axis_times_angle(R_B)
    U, _, Vt = np.linalg.svd(a.T @ b)
    R = U @ Vt
    if len(a) < 3 and np.linalg.det(R) > 0:  # which sign LAPACK chooses is chance
        R = U @ np.diag([1, 1, -1]) @ Vt
    return R


@wrong("first_motion_only")
def one_motion(R_A, R_B):
    a, b = (_axis_times_angle(R[:1])[0] for R in (R_A, R_B))
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    x, y, z = np.cross(b, a)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + K + K @ K / (1 + a @ b)
