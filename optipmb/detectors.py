"""Results of detection frameworks as the columns of `OnlineTracker.update`, by their documented attributes.

    tracks = tracker.update(**optipmb.from_detector(result, classes=["Car", "Pedestrian", "Cyclist"]), t=t)

No framework is imported. Arrays may be of numpy, torch or cupy, or lists.

    openpcdet     a dictionary with `pred_boxes`, `pred_scores` and `pred_labels`, which count from 1
    mmdet3d       an object with `pred_instances_3d`; its boxes are given by the middle of their bottoms
    nuscenes      a list of boxes with `detection_name`, `translation`, `size`, `rotation`, or of such dictionaries
    supervision   an object with `xyxy`, `confidence`, `class_id` and `data`: pixel boxes
    ultralytics   an object with `boxes` and `names`: pixel boxes
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from optipmb.model.errors import FrameError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from optipmb.cameras.ground_camera import GroundCamera
    from optipmb.model.rows import Array

    Classes = Sequence[str] | Mapping[int, str] | None

_BOX: Final = ("detection_name", "translation", "size", "rotation")


def from_detector(
    result: Any,
    *,
    classes: Sequence[str] | Mapping[int, str] | None = None,
    camera: GroundCamera | None = None,
    form: str | None = None,
) -> dict[str, Any]:
    """Return the columns of a detector's result for one frame.

    Args:
        result: of one of the forms of this module; a list of one result is that result.
        classes: names of the classes that the labels are the places of, or by label; some forms have them.
        camera: that pixel boxes need; it becomes a column, for `update`.
        form: of the result, where it could be several.

    Raises:
        FrameError: the form is unknown or could be several, or an attribute is wrong; names it.
    """
    found = forms_of(result) if form is None else (form,)
    if len(found) != 1 or found[0] not in _FORMS:
        received = f"{type(result).__name__}, {' and '.join(found) or 'none of them'}"
        way = "give others as columns: update({'center', 'size', 'yaw', 'score', 'class'}), or boxes of an image as "
        way += "update({'box', 'class', 'score'}, camera=…)"
        raise FrameError("boxes", f"a result of {', '.join(_FORMS)}, or form=; {way}", received)
    one = result if found[0] == "nuscenes" else _one(result)
    return _FORMS[found[0]](one, classes, camera)


def forms_of(result: Any) -> tuple[str, ...]:
    """Return the forms that an object has."""
    if isinstance(result, list | tuple):
        if result and all(_has(one, _BOX) for one in result):
            return ("nuscenes",)
        return forms_of(result[0]) if result and not isinstance(result[0], list | tuple) else ()
    return tuple(name for name, attributes in _KNOWN_BY.items() if _has(result, attributes))


def _has(one: Any, names: Sequence[str]) -> bool:
    return all(name in one if isinstance(one, Mapping) else hasattr(one, name) for name in names)


def _one(result: Any) -> Any:
    if not isinstance(result, list | tuple):
        return result
    if len(result) != 1:
        raise FrameError("boxes", "one frame at a time", f"a list of {len(result)}")
    return result[0]


def _value(one: Any, name: str) -> Any:
    return one[name] if isinstance(one, Mapping) else getattr(one, name)


def _array(name: str, values: Any, *shapes: tuple[int, ...]) -> Array:
    """Return an array of one of some shapes behind the number of boxes, as a copy."""
    try:
        array = np.array(on_host(values), dtype=np.float64)
    except (TypeError, ValueError):
        raise FrameError(name, "numbers", f"{values!r:.60}") from None
    if array.size == 0:
        array = np.empty((0, *shapes[0]))
    if array.shape[1:] not in shapes or array.ndim == 0:
        expected = " or ".join(str(("N", *shape)).replace("'", "") for shape in shapes)
        raise FrameError(name, expected, str(array.shape))
    return array


def on_host(values: Any) -> Any:
    """Return an array of torch or cupy as one of numpy, and masked numbers as NaN; others as they are."""
    if hasattr(values, "detach"):
        values = values.detach().cpu()
        return (values.float() if "bfloat16" in str(getattr(values, "dtype", "")) else values).numpy()
    if hasattr(values, "__cuda_array_interface__"):
        return values.get()
    if isinstance(values, np.ma.MaskedArray):
        nothing: Any = np.nan if values.dtype.kind in "iuf" else None
        return np.where(values.mask, nothing, values.data) if np.ma.is_masked(values) else values.data
    return values


def _columns(name: str, count: int, **columns: Any) -> dict[str, Any]:
    for column, values in columns.items():
        if len(values) != count:
            raise FrameError(column, f"{count} values, as {name} has", str(len(values)))
    return columns


def _names(name: str, labels: Array, classes: Classes, first: int = 0) -> list[str]:
    """Return the names of labels, which count from `first`."""
    if len(labels) and not classes:
        raise FrameError("classes", f"the names of the classes that {name} counts", "none")
    if isinstance(classes, Mapping):
        known = {int(label): str(name) for label, name in classes.items()}
        for place, label in enumerate(labels.tolist()):
            if label not in known:
                raise FrameError(f"{name}[{place}]", f"one of {', '.join(map(str, known))}", f"{label:g}")
        return [known[int(label)] for label in labels]
    names = tuple(classes or ())
    for place, label in enumerate(labels.tolist()):
        if label != int(label) or not first <= label < first + len(names):
            raise FrameError(f"{name}[{place}]", f"{first} to {first + len(names) - 1}", f"{label:g}")
    return [names[int(label) - first] for label in labels]


def _openpcdet(result: Any, classes: Classes, _: GroundCamera | None) -> dict[str, Any]:
    boxes = _array("pred_boxes", _value(result, "pred_boxes"), (7,), (9,))
    score, labels = (_array(name, _value(result, name), ()) for name in ("pred_scores", "pred_labels"))
    _columns("pred_boxes", len(boxes), pred_scores=score, pred_labels=labels)
    return _of_boxes(boxes, score, _names("pred_labels", labels, classes, 1))


def _of_boxes(boxes: Array, score: Array, names: list[str]) -> dict[str, Any]:
    columns = {"center": boxes[:, :3], "size": boxes[:, 3:6], "yaw": boxes[:, 6], "score": score, "label": names}
    return columns | ({"velocity": boxes[:, 7:]} if boxes.shape[1] > 7 else {})  # noqa: PLR2004 - without velocities


def _mmdet3d(result: Any, classes: Classes, _: GroundCamera | None) -> dict[str, Any]:
    path = "pred_instances_3d"
    found = result.pred_instances_3d
    if not _has(found, ("bboxes_3d", "scores_3d", "labels_3d")):
        raise FrameError(path, "bboxes_3d, scores_3d and labels_3d", f"{type(found).__name__} without them")
    kind = type(found.bboxes_3d).__name__
    boxes = _array(f"{path}.bboxes_3d.tensor", found.bboxes_3d.tensor, (7,), (9,))
    score, labels = (_array(f"{path}.{name}", getattr(found, name), ()) for name in ("scores_3d", "labels_3d"))
    _columns(f"{path}.bboxes_3d", len(boxes), scores_3d=score, labels_3d=labels)
    if kind == "CameraInstance3DBoxes":  # x right, y down, z ahead; length, height, width
        x, y, z, length, height, width, yaw, *speed = boxes.T
        turned = [z, -x, -y, length, width, height, -yaw - 0.5 * np.pi, *([speed[1], -speed[0]] if speed else [])]
        boxes = np.column_stack(turned)
    elif kind not in {"LiDARInstance3DBoxes", "DepthInstance3DBoxes"}:
        expected = "LiDARInstance3DBoxes, DepthInstance3DBoxes or CameraInstance3DBoxes"
        raise FrameError(f"{path}.bboxes_3d", expected, kind)
    boxes[:, 2] += 0.5 * boxes[:, 5]
    known = classes or (getattr(result, "metainfo", None) or {}).get("classes")
    return _of_boxes(boxes, score, _names(f"{path}.labels_3d", labels, known))


def _nuscenes(result: Any, _: Classes, __: GroundCamera | None) -> dict[str, Any]:
    def column(name: str, *shape: int, without: Any = None) -> Array:
        values = [_value(one, name) if without is None or _has(one, (name,)) else without for one in result]
        return _array(f"boxes.{name}", values, shape)

    wlh, turn = column("size", 3), column("rotation", 4)
    w, x, y, z = turn.T
    score = column("detection_score", without=-1.0)
    return {
        "center": column("translation", 3),
        "size": wlh[:, [1, 0, 2]],
        "yaw": np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z),
        "velocity": column("velocity", 2, without=(np.nan, np.nan)),
        "score": np.where(score == -1.0, 1.0, score),
        "label": [str(_value(one, "detection_name")) for one in result],
    }


def _supervision(result: Any, classes: Classes, camera: GroundCamera | None) -> dict[str, Any]:
    boxes = _array("xyxy", result.xyxy, (4,))
    score = np.ones(len(boxes)) if result.confidence is None else _array("confidence", result.confidence, ())
    names = (result.data or {}).get("class_name")
    if names is None:
        labels = np.empty(0) if result.class_id is None else _array("class_id", result.class_id, ())
        names = _names("class_id", labels, classes)
    _columns("xyxy", len(boxes), confidence=score, class_id=names)
    return _of_pixels(boxes, score, [str(name) for name in names], camera)


def _ultralytics(result: Any, classes: Classes, camera: GroundCamera | None) -> dict[str, Any]:
    if result.boxes is None:
        received = "oriented boxes (obb) alone" if getattr(result, "obb", None) is not None else "None"
        raise FrameError("boxes", "a result of detection with boxes", received)
    shape = getattr(result, "orig_shape", None)
    if camera is not None and shape is not None and tuple(shape[1::-1]) != camera.image:
        raise FrameError("orig_shape", f"{camera.image[::-1]}, the image of the camera", str(tuple(shape)))
    boxes = _array("boxes.xyxy", result.boxes.xyxy, (4,))
    score, labels = (_array(f"boxes.{name}", getattr(result.boxes, name), ()) for name in ("conf", "cls"))
    _columns("boxes.xyxy", len(boxes), conf=score, cls=labels)
    return _of_pixels(boxes, score, _names("boxes.cls", labels, classes or result.names), camera)


def _of_pixels(boxes: Array, score: Array, names: list[str], camera: GroundCamera | None) -> dict[str, Any]:
    if camera is None:
        raise FrameError("camera", "the GroundCamera that pixel boxes need", "none")
    return {"box": boxes, "score": score, "label": names, "camera": camera}


_KNOWN_BY: Final = MappingProxyType({
    "openpcdet": ("pred_boxes", "pred_scores", "pred_labels"),
    "mmdet3d": ("pred_instances_3d",),
    "supervision": ("xyxy", "confidence", "class_id", "data"),
    "ultralytics": ("boxes", "names"),
})  # fmt: skip
"""Attributes, or keys of a dictionary, that a form is known by."""
_FORMS: Final[Mapping[str, Callable[[Any, Classes, GroundCamera | None], dict[str, Any]]]] = MappingProxyType({
    "openpcdet": _openpcdet, "mmdet3d": _mmdet3d, "nuscenes": _nuscenes, "supervision": _supervision,
    "ultralytics": _ultralytics,
})  # fmt: skip
