"""Messages shown in Rerun, seen from above and in 3D.

World frame: metres, z up. Entities of a stream stand below its name: `tracks` (boxes with id and existence
probability), `tracks/velocity` (the way of the next second), `tracks/covariance` (two standard deviations of the
position), `tracks/trails`, `detections`, `cloud`, `sensor`, `poisson` (where objects are expected that are
not detected yet) and `poisson/weight` (how many), and the figures `count/…`. Rerun is an extra of the installation.
"""

import collections
import threading
import time
from collections.abc import Iterable
from typing import Final, Self

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from optipmb_client.errors import ConnectionFailed
from optipmb_client.incoming import Arrival, Inbox
from optipmb_client.zenoh import Connection
from optipmb_schemas import PREFIX, Density, Detections, Keys, Message, Points, Tracks
from optipmb_schemas.json_form import shown

from optipmb_tools.geometry import Floats, rotation_of, shown_boxes
from optipmb_tools.views.colours import identities_of, rgb_of

TRAIL_S: Final = 5.0
SIGMAS: Final = 2.0
HIGH: Final = 90.0  # metres above the ground from where the view from above is taken

SURE: Final = 0.5  # tracks with a lower score are drawn thin and without a label

UNIX_NS: Final = 10**17  # stamps above it are times since 1970; below, seconds since some start

LINE: Final = -1.5  # thickness of lines in points on the screen at any distance: so Rerun takes negative radii

TICK_M: Final = 20.0
AXES_M: Final = (42.0, 34.0)  # how far the axes are from the middle, to the left and below

GREY: Final = (130, 130, 130)
INK: Final = (30, 30, 30)

FAINT: Final = (235, 225, 235)
EXPECTED: Final = (120, 90, 140)
"""Colours of a Poisson component that expects next to nothing, and of one that expects an object or more."""

QUERY_PERIOD_S: Final = 0.5
QUERY_S: Final = 1.0

SERIES: Final = (
    ("tracks", "tracks", (0, 114, 178)),
    ("surer_tracks", "of score 0.5 and more", (213, 94, 0)),
    ("detections", "detections", GREY),
)

LEGEND: Final = """\
| | |
|---|---|
| **box** | a track; its colour belongs to its id; beside it id and probability of existence |
| **thin box** | a track with a score below 0.5 |
| **arrow** | the way of the next second |
| **ellipse** | the position, two standard deviations |
| **line** | the way of the last 5 s |
| **grey box** | a detection |
| **black arrow** | the sensor and where it looks |
| **points** | the cloud |
| **faint ellipse** | with `--poisson`: an object not yet detected may be here; the darker, the likelier |

Axes in metres, the grid has lines every 10 m, x to the right and y up when seen from above.
"""


class View:
    """Shows messages of any streams on a Rerun recording; one stands in the middle, the first unless it is named.

    Args:
        recording: Where to; its sink (viewer, file, server) is the caller's.
        stream: The stream that the views follow.
    """

    def __init__(self, recording: rr.RecordingStream, stream: str | None = None) -> None:
        self._recording = recording
        self._followed = stream
        self._begun = False
        self._trails: dict[str, dict[int, collections.deque[tuple[int, Floats]]]] = {}
        self._places: dict[str, Floats] = {}
        self._axes_at: tuple[float, ...] = ()
        recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        recording.log("legend", rr.TextDocument(LEGEND, media_type="text/markdown"), static=True)

    def show(self, message: Message) -> None:
        """Show detections, points, tracks or a density with a stamp; other messages are ignored."""
        if not isinstance(message, Density | Detections | Points | Tracks) or message.stamp_ns is None:
            return
        if message.stamp_ns >= UNIX_NS:
            self._recording.set_time("stamp", timestamp=np.datetime64(message.stamp_ns, "ns"))
        else:
            self._recording.set_time("seconds", duration=np.timedelta64(message.stamp_ns, "ns"))
        if isinstance(message, Tracks):
            self._show_tracks(message)
        elif isinstance(message, Detections):
            self._show_detections(message)
        elif isinstance(message, Density):
            self._show_density(message)
        else:
            points, _ = _to_world(message, message.xyz.astype(np.float64))
            self._recording.log(f"{message.stream}/cloud", rr.Points3D(points, colors=_by_height(points), radii=0.03))

    def _show_tracks(self, all_tracks: Tracks) -> None:
        tracks = _shown(all_tracks)
        name, n = tracks.stream, len(tracks.id)
        if self._followed in {None, name}:
            middle = tracks.center[:, :2].mean(axis=0) if n else np.zeros(2)
            self._lay_out(name, self._places.get(name, middle))
        identities = identities_of(tracks)
        colours = np.array([rgb_of(identity) for identity in identities], dtype=np.uint8).reshape(-1, 3)
        sure = tracks.score >= SURE
        quaternions = _turned(tracks.yaw)
        labels = [
            f"{identity} {existence:.2f}" if certain else ""
            for identity, existence, certain in zip(identities, tracks.existence, sure, strict=True)
        ]
        log = self._recording.log
        log(
            f"{name}/tracks",
            rr.Boxes3D(
                centers=tracks.center,
                half_sizes=0.5 * tracks.size,
                quaternions=quaternions,
                colors=colours,
                radii=np.where(sure, LINE, 0.4 * LINE),
                labels=labels,
                show_labels=True,
            ),
        )
        velocity = np.column_stack([tracks.velocity, np.zeros(n)])
        log(f"{name}/tracks/velocity", rr.Arrows3D(origins=tracks.center, vectors=velocity, colors=colours, radii=LINE))
        deviations, turns = _ellipses(tracks.covariance[:, :2, :2])
        log(
            f"{name}/tracks/covariance",
            rr.Ellipsoids3D(
                centers=tracks.center,
                half_sizes=np.column_stack([SIGMAS * deviations, np.full(n, 0.01)]),
                quaternions=_turned(turns),
                colors=colours,
                line_radii=0.5 * LINE,
            ),
        )
        strips, ids = self._trail(tracks)
        log(f"{name}/tracks/trails", rr.LineStrips3D(strips, colors=[rgb_of(one) for one in ids], radii=0.7 * LINE))
        log(f"{name}/count/tracks", rr.Scalars(float(n)))
        log(f"{name}/count/unconfirmed_tracks", rr.Scalars(float(len(all_tracks.id) - n)))
        log(f"{name}/count/surer_tracks", rr.Scalars(float(sure.sum())))

    def _show_detections(self, detections: Detections) -> None:
        name = detections.stream
        center, turn = _to_world(detections, np.nan_to_num(detections.center))
        size, yaw = shown_boxes(detections)
        boxes = rr.Boxes3D(
            centers=center,
            half_sizes=0.5 * size,
            quaternions=_turned(yaw + turn),
            colors=GREY,
            radii=0.5 * LINE,
        )
        self._recording.log(f"{name}/detections", boxes)
        self._recording.log(f"{name}/count/detections", rr.Scalars(float(len(center))))
        if (pose := detections.pose) is not None:
            self._places[name] = pose.translation[:2]
            w, x, y, z = pose.quaternion
            place = rr.Transform3D(translation=pose.translation, quaternion=rr.Quaternion(xyzw=[x, y, z, w]))
            self._recording.log(f"{name}/sensor", place, rr.Arrows3D(vectors=[[3.0, 0.0, 0.0]], colors=INK, radii=0.15))

    def _show_density(self, density: Density) -> None:
        """Show where objects are expected; square roots, because most weights are small."""
        share = np.sqrt(np.minimum(density.weight, 1.0))
        centers = np.column_stack([density.mean[:, :2], density.z])
        colours = np.rint(np.array(FAINT) * (1 - share[:, None]) + np.array(EXPECTED) * share[:, None]).astype(np.uint8)
        deviations, turns = _ellipses(density.covariance[:, :2, :2])
        path = f"{density.stream}/poisson"
        ellipses = rr.Ellipsoids3D(
            centers=centers,
            half_sizes=np.column_stack([SIGMAS * deviations, np.full(len(share), 0.01)]),
            quaternions=_turned(turns),
            colors=colours,
            line_radii=0.4 * LINE,
        )
        self._recording.log(path, ellipses)
        self._recording.log(f"{path}/weight", rr.Points3D(centers, colors=colours, radii=share))

    def _lay_out(self, stream: str, middle: Floats) -> None:
        """Send the layout once, for the first stream or the one that was named, and keep numbered axes near it."""
        if not self._begun:
            self._begun, self._followed = True, stream
            self._recording.send_blueprint(_blueprint(stream, middle, moving=stream in self._places))
            for name, what, colour in SERIES:
                line = rr.SeriesLines(names=what, colors=colour)
                self._recording.log(f"{stream}/count/{name}", line, static=True)
        near = np.round(middle / TICK_M) * TICK_M
        if self._axes_at == (at := tuple(near.tolist())):
            return
        self._axes_at = at
        along = np.arange(-2, 4) * TICK_M
        ticks = [[near[0] + step, near[1] - AXES_M[1], 0.0] for step in along]
        ticks += [[near[0] - AXES_M[0], near[1] + step, 0.0] for step in along]
        labels = [f"x = {x:.0f} m" for x, _, _ in ticks[: len(along)]]
        labels += [f"y = {y:.0f} m" for _, y, _ in ticks[len(along) :]]
        self._recording.log("axes", rr.Points3D(ticks, labels=labels, colors=INK, radii=LINE, show_labels=True))

    def _trail(self, tracks: Tracks) -> tuple[list[Floats], list[int]]:
        """Return the ways (k, 3) of the last seconds and the ids that they belong to."""
        trails = self._trails.setdefault(tracks.stream, {})
        for identity, center in zip(identities_of(tracks), tracks.center, strict=True):
            trails.setdefault(identity, collections.deque()).append((tracks.stamp_ns, center))
        for identity, trail in tuple(trails.items()):
            while trail and not 0 <= tracks.stamp_ns - trail[0][0] <= TRAIL_S * 1e9:
                trail.popleft()
            if not trail:
                del trails[identity]
        return [np.array([place for _, place in trail]) for trail in trails.values()], list(trails)


def _blueprint(stream: str, middle: Floats, *, moving: bool) -> rrb.Blueprint:
    """Return the layout: from above, and 3D, counts and legend. Views follow a sensor with a pose."""
    x, y = middle.tolist()
    contents = [f"+ /{stream}/**", f"- /{stream}/count/**", "+ /axes"]
    follow = f"/{stream}/sensor" if moving else None
    grid = rrb.LineGrid3D(visible=True, spacing=10.0, color=[205, 205, 205])

    def scene(name: str, position: Iterable[float], up: Iterable[float]) -> rrb.Spatial3DView:
        eye = rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=list(position),
            look_target=[x, y, 0.0],
            eye_up=list(up),
            tracking_entity=follow,
        )
        return rrb.Spatial3DView(
            name=name, origin="/", contents=contents, eye_controls=eye, line_grid=grid, background=[255, 255, 255]
        )

    return rrb.Blueprint(
        rrb.Horizontal(
            scene(f"{stream} from above, a line every 10 m", [x, y, HIGH], [0.0, 1.0, 0.0]),
            rrb.Vertical(
                scene("in 3D", [x - 30.0, y - 20.0, 20.0], [0.0, 0.0, 1.0]),
                rrb.TimeSeriesView(name="how many", origin=f"/{stream}/count"),
                rrb.TextDocumentView(name="legend", origin="/legend"),
                row_shares=[4, 2, 3],
            ),
            column_shares=[3, 2],
        ),
        collapse_panels=True,
    )


def _to_world(message: Detections | Points, points: Floats) -> tuple[Floats, float]:
    """Return points (N, 3) in the world frame, and the turn of the sensor seen from above."""
    if message.frame == "world" or message.pose is None:
        return points, 0.0
    rotation = rotation_of(message.pose.quaternion)
    return points @ rotation.T + message.pose.translation, float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def _shown(tracks: Tracks) -> Tracks:
    rows = shown(tracks)
    columns = {name: column[rows] for name in tracks.arrays if (column := getattr(tracks, name)) is not None}
    return tracks.model_copy(update=columns)


def _turned(yaw: Floats) -> Floats:
    """Return quaternions x y z w (N, 4) of turns about z."""
    zero = np.zeros_like(yaw)
    return np.column_stack([zero, zero, np.sin(0.5 * yaw), np.cos(0.5 * yaw)])


def _ellipses(covariance: Floats) -> tuple[Floats, Floats]:
    """Return standard deviations (N, 2) along the axes of the ellipses of (N, 2, 2), and their turns (N,)."""
    if not len(covariance):
        return np.zeros((0, 2)), np.zeros(0)
    values, vectors = np.linalg.eigh(covariance)
    return np.sqrt(np.maximum(values, 0.0)), np.arctan2(vectors[:, 1, 0], vectors[:, 0, 0])


def _by_height(points: Floats) -> np.ndarray:
    """Return colours (N, 3) from dark to light blue with the height, which all can tell from the tracks' boxes."""
    low, high = np.quantile(points[:, 2], [0.02, 0.98]) if len(points) else (0.0, 1.0)
    share = np.clip((points[:, 2] - low) / max(high - low, 1e-6), 0.0, 1.0)[:, None]
    return np.asarray(np.array([60, 70, 90]) * (1 - share) + np.array([170, 190, 215]) * share, dtype=np.uint8)


class DensityQueries:
    """Queries, on a thread of its own, the density of every stream that has had tracks since the last query.

    Answers go into an inbox, among the messages that were subscribed to; errors are left out. A stream is asked twice a
    second at most, and not at all while it is silent. So a service that is slow to answer delays neither tracks nor
    their reader.

    Args:
        connection: Where to ask; closed by the caller, after this.
        inbox: Where answers go, by the key of the query.
        prefix: Of the keys.
    """

    def __init__(self, connection: Connection, inbox: Inbox, prefix: str = PREFIX) -> None:
        self._connection = connection
        self._inbox = inbox
        self._keys = Keys(prefix)
        self._due: set[str] = set()
        self._lock = threading.Lock()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="densities", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join(2 * QUERY_S)

    def note(self, stream: str) -> None:
        """Say that a stream has new tracks; never waits."""
        with self._lock:
            self._due.add(stream)

    def _run(self) -> None:
        while not self._over.wait(QUERY_PERIOD_S):
            with self._lock:
                due, self._due = self._due, set()
            for stream in sorted(due):
                if self._over.is_set():
                    return
                self._ask(self._keys.query(stream, "density"))

    def _ask(self, key: str) -> None:
        try:
            answers = self._connection.query(key, timeout=QUERY_S)
        except ConnectionFailed:
            return  # the connection is being closed, or links again
        for answer in answers:
            if answer.ok:
                self._inbox.put(Arrival(answer.key, answer.payload, answer.encoding, time.monotonic_ns()))
