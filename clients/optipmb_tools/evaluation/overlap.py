"""Overlap of upright boxes, exactly and for many pairs at once.

Conventions: metres, radians, z up. Two boxes overlap where their outlines in the plane and their height intervals do.
The outline of the overlap is found by clipping one rectangle at the four sides of the other (Sutherland and Hodgman,
1974), for all pairs together.
"""

import numpy as np

from optipmb_tools.geometry import Bools, Floats, box_corners

_MAX_CORNERS = 8  # two rectangles overlap in a polygon of at most eight corners


def iou_3d(first: tuple[Floats, Floats, Floats], second: tuple[Floats, Floats, Floats]) -> Floats:
    """Return the intersection over union (P,) of the volumes of pairs of boxes: centres, sizes (P, 3) and yaws (P,)."""
    (center_a, size_a, _), (center_b, size_b, _) = first, second
    top = np.minimum(center_a[:, 2] + 0.5 * size_a[:, 2], center_b[:, 2] + 0.5 * size_b[:, 2])
    bottom = np.maximum(center_a[:, 2] - 0.5 * size_a[:, 2], center_b[:, 2] - 0.5 * size_b[:, 2])
    common = intersection_area(first, second) * np.maximum(top - bottom, 0.0)
    volume = np.prod(size_a, axis=1) + np.prod(size_b, axis=1)
    return np.asarray(common / (volume - common), dtype=np.float64)


def iou_2d(first: Floats, second: Floats) -> Floats:
    """Return the intersection over union (P,) of pairs of image boxes (P, 4) x1 y1 x2 y2; 0 for boxes without area."""
    low, high = np.maximum(first[:, :2], second[:, :2]), np.minimum(first[:, 2:], second[:, 2:])
    common = np.prod(np.maximum(high - low, 0.0), axis=1)
    area = np.prod(first[:, 2:] - first[:, :2], axis=1) + np.prod(second[:, 2:] - second[:, :2], axis=1)
    return np.asarray(np.divide(common, area - common, out=np.zeros(len(common)), where=common > 0.0), dtype=np.float64)


def intersection_area(first: tuple[Floats, Floats, Floats], second: tuple[Floats, Floats, Floats]) -> Floats:
    """Return the area (P,) common to the outlines of pairs of boxes; arguments as in `iou_3d`."""
    (center_a, size_a, yaw_a), (center_b, size_b, yaw_b) = first, second
    area = np.zeros(len(center_a))
    reach = 0.5 * (np.hypot(size_a[:, 0], size_a[:, 1]) + np.hypot(size_b[:, 0], size_b[:, 1]))
    near = np.flatnonzero(np.linalg.norm(center_a[:, :2] - center_b[:, :2], axis=1) < reach)
    if not len(near):
        return area
    # In the frame of the second box its sides are four lines x = +-l/2 and y = +-w/2.
    offset = np.zeros((len(near), 3))
    offset[:, :2] = center_a[near, :2] - center_b[near, :2]
    cos, sin = np.cos(yaw_b[near]), np.sin(yaw_b[near])
    local = np.column_stack(
        [cos * offset[:, 0] + sin * offset[:, 1], cos * offset[:, 1] - sin * offset[:, 0], np.zeros(len(near))]
    )
    polygon = box_corners(local, size_a[near], yaw_a[near] - yaw_b[near])[:, 3::-1, :2]  # counter-clockwise
    valid = np.ones(polygon.shape[:2], dtype=np.bool_)
    for axis in (0, 1):
        for sign in (1.0, -1.0):
            polygon, valid = _clip(polygon, valid, axis, sign, 0.5 * size_b[near, axis])
    area[near] = _area(polygon, valid)
    return area


def _clip(polygon: Floats, valid: Bools, axis: int, sign: float, limit: Floats) -> tuple[Floats, Bools]:
    """Cut convex polygons (P, V, 2) at the line where sign * coordinate = limit (P,), keeping the smaller side.

    The valid corners of a polygon stand first, in order. The result has one corner more.
    """
    pairs, corners = valid.shape
    count = valid.sum(axis=1)
    following = np.where(np.arange(corners) + 1 < count[:, None], np.arange(corners) + 1, 0)
    after = np.take_along_axis(polygon, following[..., None], axis=1)
    here, there = (limit[:, None] - sign * p[..., axis] for p in (polygon, after))  # positive inside
    inside = (here >= 0.0) & valid
    crossing = valid & ((here >= 0.0) != (there >= 0.0))
    part = np.where(crossing, here, 0.0) / np.where(crossing, here - there, 1.0)
    cut = polygon + part[..., None] * (after - polygon)
    # Each corner gives itself if it is inside, then the point where the side that begins at it crosses the line.
    points = np.stack([polygon, cut], axis=2).reshape(pairs, 2 * corners, 2)
    kept = np.stack([inside, crossing], axis=2).reshape(pairs, 2 * corners)
    order = np.argsort(~kept, axis=1, kind="stable")[:, : min(corners + 1, _MAX_CORNERS)]
    return np.take_along_axis(points, order[..., None], axis=1), np.take_along_axis(kept, order, axis=1)


def _area(polygon: Floats, valid: Bools) -> Floats:
    """Return the areas (P,) of convex polygons with their valid corners first."""
    # Corners that are none are put on the first one, where they add nothing.
    points = np.where(valid[..., None], polygon, polygon[:, :1]) - polygon[:, :1]
    after = np.roll(points, -1, axis=1)
    twice = (points[..., 0] * after[..., 1] - points[..., 1] * after[..., 0]).sum(axis=1)
    return np.where(valid.any(axis=1), 0.5 * np.abs(twice), 0.0)
