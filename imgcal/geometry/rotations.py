"""Rotations: 6D representation, rotation vectors, Euler angles, geodesic distance. Stateless functions of tensors."""

from __future__ import annotations

import torch
from torch import Tensor


def rotation_from_6d(sixd: Tensor) -> Tensor:
    """Build rotation matrices from the 6D representation by Gram-Schmidt.

    Args:
        sixd: (*B, 6) first column, then second column of a matrix near the rotation; any scale.

    Returns:
        (*B, 3, 3) rotation matrices. Parallel or zero columns are singular: the result is then not a rotation.

    Source: Zhou et al., CVPR 2019; paper section 3, "6D Rotation Parameterization".

    Examples:
        >>> turned = rotation_from_vector(torch.tensor([0.1, -0.2, 0.3]))
        >>> torch.allclose(rotation_from_6d(sixd_from_rotation(turned)), turned, atol=1e-6)
        True
    """
    first = torch.nn.functional.normalize(sixd[..., :3], dim=-1)
    second = sixd[..., 3:] - (first * sixd[..., 3:]).sum(-1, keepdim=True) * first
    second = torch.nn.functional.normalize(second, dim=-1)
    return torch.stack((first, second, torch.linalg.cross(first, second)), dim=-1)


def sixd_from_rotation(rotation: Tensor) -> Tensor:
    """Take the first two columns of rotation matrices: (*B, 3, 3) -> (*B, 6)."""
    return torch.cat((rotation[..., :, 0], rotation[..., :, 1]), dim=-1)


def rotation_from_vector(vector: Tensor) -> Tensor:
    """Exponential map: rotation vectors (axis times angle, rad) to rotation matrices, smooth through zero.

    Args:
        vector: (*B, 3) rad.

    Returns:
        (*B, 3, 3) rotation matrices.

    Source: Rodrigues' formula, I + a [w] + b [w]^2 with a = sin(t)/t and b = (1 - cos(t))/t^2.

    Examples:
        >>> rotation_from_vector(torch.tensor([0.0, 0.0, torch.pi / 2])).round(decimals=6) + 0.0
        tensor([[ 0., -1.,  0.],
                [ 1.,  0.,  0.],
                [ 0.,  0.,  1.]])
    """
    x, y, z = vector.unbind(-1)
    squared = x * x + y * y + z * z
    small = squared < 1e-8
    safe = torch.where(small, torch.ones_like(squared), squared)
    angle = safe.sqrt()
    a = torch.where(small, 1 - squared / 6, angle.sin() / angle)
    # 1 - cos as 2 sin^2: no cancellation at small angles.
    b = torch.where(small, 0.5 - squared / 24, 2 * (0.5 * angle).sin().square() / safe)
    bx, by, bz = b * x, b * y, b * z
    ax, ay, az = a * x, a * y, a * z
    c = 1 - b * squared
    entries = (
        c + bx * x, bx * y - az, bx * z + ay,
        bx * y + az, c + by * y, by * z - ax,
        bx * z - ay, by * z + ax, c + bz * z,
    )  # fmt: skip
    return _matrices(entries)


def left_jacobian(vector: Tensor) -> Tensor:
    """Derivative of the exponential map: exp(w + dw) = exp(J dw) exp(w) to first order; (*B, 3) rad -> (*B, 3, 3).

    Source: Barfoot, State Estimation for Robotics, section 7.1.
    """
    squared = vector.square().sum(-1, keepdim=True).unsqueeze(-1)
    small = squared < 1e-8
    safe = torch.where(small, torch.ones_like(squared), squared)
    angle = safe.sqrt()
    b = torch.where(small, 0.5 - squared / 24, 2 * (0.5 * angle).sin().square() / safe)
    c = torch.where(small, 1 / 6 - squared / 120, (angle - angle.sin()) / (safe * angle))
    cross = cross_matrix(vector)
    return torch.eye(3, dtype=vector.dtype, device=vector.device) + b * cross + c * (cross @ cross)


def cross_matrix(vector: Tensor) -> Tensor:
    """Matrix of the cross product, `cross_matrix(a) @ b = a x b`: (*B, 3) -> (*B, 3, 3).

    Examples:
        >>> cross_matrix(torch.tensor([1.0, 0.0, 0.0])) @ torch.tensor([0.0, 1.0, 0.0])
        tensor([0., 0., 1.])
    """
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), dim=-1).unflatten(-1, (3, 3))


def vector_from_rotation(rotation: Tensor) -> Tensor:
    """Logarithm: rotation matrices to rotation vectors of angle at most pi.

    Args:
        rotation: (*B, 3, 3).

    Returns:
        (*B, 3) rad. At exactly pi the sign of the axis is arbitrary.

    Source: quaternion of the largest of the four candidates (Shepperd 1978), then 2 atan2(|v|, w) v/|v|.

    Examples:
        >>> vector_from_rotation(rotation_from_vector(torch.tensor([0.1, -0.2, 0.3])))
        tensor([ 0.1000, -0.2000,  0.3000])
    """
    quaternion = _quaternion_from_rotation(rotation)
    w, v = quaternion[..., :1], quaternion[..., 1:]
    w, v = torch.where(w < 0, -w, w), torch.where(w < 0, -v, v)
    squared = (v * v).sum(-1, keepdim=True)
    small = squared < 1e-16
    norm = torch.where(small, torch.ones_like(squared), squared).sqrt()
    factor = torch.where(small, 2 / w.clamp_min(0.5), 2 * torch.atan2(norm, w) / norm)
    return factor * v


def _quaternion_from_rotation(rotation: Tensor) -> Tensor:
    """(*B, 3, 3) -> (*B, 4) as w, x, y, z; the best conditioned of four equivalent formulas."""
    m = rotation
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    zy, xz, yx = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, zx, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    ww, xx, yy, zz = 1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22
    # Compare the candidates component by component: each component is one long row.
    largest = ww
    chosen: tuple[Tensor, ...] = (ww, zy, xz, yx)
    for square, candidate in ((xx, (zy, xx, xy, zx)), (yy, (xz, xy, yy, yz)), (zz, (yx, zx, yz, zz))):
        larger = square > largest
        largest = torch.where(larger, square, largest)
        chosen = tuple(torch.where(larger, new, old) for new, old in zip(candidate, chosen, strict=True))
    return torch.nn.functional.normalize(torch.stack(chosen, -1), dim=-1)


def rotation_from_euler(angles: Tensor) -> Tensor:
    """Rotate by Euler angles (a, b, c) about the fixed x, y, z axes, Rz(c) Ry(b) Rx(a): (*B, 3) rad -> (*B, 3, 3).

    Examples:
        >>> angles = torch.tensor([0.1, -0.2, 0.3])
        >>> euler_from_rotation(rotation_from_euler(angles))
        tensor([ 0.1000, -0.2000,  0.3000])
    """
    (sa, sb, sc), (ca, cb, cc) = angles.sin().unbind(-1), angles.cos().unbind(-1)
    entries = (
        cc * cb, cc * sb * sa - sc * ca, cc * sb * ca + sc * sa,
        sc * cb, sc * sb * sa + cc * ca, sc * sb * ca - cc * sa,
        -sb, cb * sa, cb * ca,
    )  # fmt: skip
    return _matrices(entries)


def euler_from_rotation(rotation: Tensor) -> Tensor:
    """Inverse of `rotation_from_euler`: (*B, 3, 3) -> (*B, 3) rad, the second angle within +-pi/2.

    Convention: at the gimbal lock (second angle = +-pi/2) the third angle is set to zero.
    """
    m00, _, _, m10, m11, m12, m20, m21, m22 = rotation.flatten(-2).unbind(-1)
    cosine = torch.hypot(m00, m10)
    locked = cosine < 1e-6
    a = torch.where(locked, torch.atan2(-m12, m11), torch.atan2(m21, m22))
    b = torch.atan2(-m20, cosine)
    c = torch.where(locked, 0.0, torch.atan2(m10, m00))
    return torch.stack((a, b, c), dim=-1)


def _matrices(entries: tuple[Tensor, ...]) -> Tensor:
    """Assemble nine entries (*B), row by row, into matrices (*B, 3, 3); in memory each entry stays one long row."""
    return torch.stack(entries).unflatten(0, (3, 3)).movedim((0, 1), (-2, -1))


def geodesic_angle(first: Tensor, second: Tensor) -> Tensor:
    """Angle of the rotation between two rotation matrices.

    Args:
        first: (*B, 3, 3).
        second: (*B, 3, 3).

    Returns:
        (*B,) rad in [0, pi], with a finite gradient everywhere (zero where the two are equal).

    Source: |R1 - R2|_F = 2 sqrt(2) sin(angle / 2); accurate at small angles, unlike the arc cosine of the trace.

    Examples:
        >>> geodesic_angle(torch.eye(3), rotation_from_vector(torch.tensor([0.0, 0.25, 0.0])))
        tensor(0.2500)
    """
    squared = (first - second).square().sum((-2, -1)) / 8
    trace = (first * second).sum((-2, -1))
    cosine_half_squared = (1 + trace).clamp_min(0) / 4
    tiny = torch.finfo(squared.dtype).tiny
    zero = squared <= tiny
    sine_half = torch.where(zero, torch.ones_like(squared), squared).sqrt()
    antipodal = cosine_half_squared <= tiny
    cosine_half = torch.where(antipodal, torch.ones_like(squared), cosine_half_squared).sqrt()
    angle = 2 * torch.atan2(sine_half, torch.where(antipodal, torch.zeros_like(squared), cosine_half))
    return torch.where(zero, torch.zeros_like(angle), angle)
