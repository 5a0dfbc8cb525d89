"""The tracks of a frame on their way out: what the tracker made, and what their message has beside it.

The message itself is made when somebody reads it. To be published, its bytes are put together without it: the columns
of the tracks lie one behind the other in one array, in the order in which the message has them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np
import optipmb_schemas as schemas

import optipmb
from optipmb.records import record

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb_service.session.timeline import FrameId

COLUMNS: Final = tuple(optipmb.Tracks.described)


@record
class FrameTracks:
    """The tracks of a frame.

    Attributes:
        tracks: what the tracker made, with numbers that a message may hold.
        header: the fields of the message before the columns, those without a value left out.
        others: the fields behind the columns: classes and predicted paths, where the profile has them.
    """

    tracks: optipmb.Tracks
    header: dict[str, Any]
    others: dict[str, Any]

    @property
    def message(self) -> schemas.Tracks:
        """The message, without its delivery part."""
        columns: dict[str, Any] = dict(self.tracks.columns())
        columns["confirmed"] = columns["confirmed"].astype(np.int64)
        for column in columns.values():
            column.flags.writeable = False
        return schemas.Tracks.trusted(self.header | columns | self.others)

    def encoded(self, delivery: dict[str, Any]) -> bytes:
        """Return the bytes of the message with a delivery part of these values, all that it has, in its order."""
        if self.others:
            return schemas.encode(self.message, delivery=schemas.Delivery.trusted(delivery))
        return schemas.encode_columns(schemas.Tracks, self.header, COLUMNS, self.tracks.words, {"delivery": delivery})


def tracks_of(  # noqa: PLR0913 - all keywords, each a field of the message
    tracks: optipmb.Tracks,
    paths: optipmb.PredictedPaths | None,
    class_probability: NDArray[np.float64] | None = None,
    *,
    stream: str,
    frame_id: FrameId,
    session: str,
    revision: int,
    parameters: optipmb.Parameters,
    cloud_used: bool,
    gap: int,
    ignored: int,
) -> FrameTracks:
    """Return the tracks of a frame, with paths and classes if there are any.

    What the tracker made of checked detections needs one look, not the checks of a message from elsewhere; where that
    look finds something odd, those checks say what it is.

    Raises:
        schemas.MessageError: the tracks hold numbers that no message may.
    """
    header: dict[str, Any] = {
        "stream": stream,
        "epoch": frame_id.epoch,
        "seq": frame_id.seq,
        "stamp_ns": frame_id.stamp_ns,
        "sensor": frame_id.sensor,
        "session": session,
        "revision": revision,
        "profile": parameters.name,
        "cloud_used": cloud_used,
        "gap": gap,
        "ignored": ignored,
        "labels": parameters.labels,
    }
    if not frame_id.sensor:
        del header["sensor"]
    others: dict[str, Any] = {}
    if class_probability is not None:
        others |= schemas.class_fields(class_probability)
    if paths is not None:
        others |= schemas.path_fields(paths.horizons, paths.mean, paths.covariance)
    if not optipmb.sound(tracks):
        columns: dict[str, Any] = dict(tracks.columns()) | {"confirmed": tracks.confirmed.astype(np.int64)}
        schemas.Tracks(**header, **columns, **others)
    return FrameTracks(tracks, header, others)
