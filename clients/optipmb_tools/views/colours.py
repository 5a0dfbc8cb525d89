"""The colours of tracks, the same in every picture and view.

A colour belongs to a track id, or, where tracks are joined over gaps, to the object. The colours are from a set that
most people with a colour vision deficiency can tell apart (Okabe and Ito, 2008); after seven tracks they come round
again, so pictures also show the id of each track.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from optipmb_schemas import Tracks

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#8C6D1F")


def colour_of(identity: int) -> str:
    """Return the colour of a track as `#RRGGBB`."""
    return COLOURS[identity % len(COLOURS)]


def rgb_of(identity: int) -> tuple[int, int, int]:
    """Return the colour of a track as red, green, blue, each 0 to 255."""
    red, green, blue = bytes.fromhex(colour_of(identity)[1:])
    return red, green, blue


def identities_of(tracks: "Tracks") -> list[int]:
    """Return the ids that views show: of the object where it is decided, as UUIDs of ROS 2, else of the track."""
    found: list[int] = tracks.id.tolist()
    if tracks.object is not None:
        found = [one if number < 0 else number for one, number in zip(found, tracks.object.tolist(), strict=True)]
    return found
