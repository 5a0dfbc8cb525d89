"""Pictures of the pages: `make pictures`; needs the extra `demo`."""

from __future__ import annotations

import itertools
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Final

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

import gaps
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Polygon, Rectangle
from optipmb_service.links.linker import Linker
from optipmb_service.links.places import WorldFrame
from optipmb_service.settings import LinkSettings
from optipmb_tools.cli import run
from optipmb_tools.datasets import open_dataset
from optipmb_tools.run import profiles
from optipmb_tools.run.rejoining import RejoinOptions, tracklets
from optipmb_tools.run.tracking import Tracking, track_whole
from sites import View, circle, copied, plaza

import optipmb
from optipmb.joining.evidence import motion_of, motion_score
from optipmb.world.zones import Zone, ZoneState, observe

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CAR, GHOST, TRUTH, TRACK = "#0072B2", "#D55E00", "#B5B5B5", "#0072B2"
LINKED = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#8C6D1F", "#00487A", "#93400A", "#006B4E")
RATE = 10
FRAMES = 70
MISSED = range(30, 40)
GHOST_FRAMES = (5, 7)
ENTERS = 20
"""Frame in which the second car of the zone comes."""


def place_of(frame: int) -> tuple[float, float]:
    """Return where the car is: it turns to the left at a crossing."""
    angle = np.clip((frame - 15) / 40, 0.0, 1.0) * np.pi / 2
    before, after = min(frame, 15) * 0.5, max(frame - 55, 0) * 0.5
    return float(before + 12.7 * np.sin(angle)), float(12.7 * (1.0 - np.cos(angle)) + after)


def scene() -> tuple[list[optipmb.OnlineTracks], list[tuple[int, float, float]]]:
    """Return the tracks of each frame, and the detections of the car as (frame, x, y)."""
    rng = np.random.default_rng(3)
    tracker = optipmb.OnlineTracker("generic")
    tracks, found = [], []
    for frame in range(FRAMES):
        boxes = []
        (x, y), (ahead_x, ahead_y) = place_of(frame), place_of(frame + 1)
        heading = float(np.arctan2(ahead_y - y, ahead_x - x))
        if frame not in MISSED:
            x, y = np.array((x, y)) + rng.normal(0.0, 0.12, 2)
            boxes.append((float(x), float(y), heading, 0.8))
            found.append((frame, float(x), float(y)))
        if frame in GHOST_FRAMES:
            boxes.append((4.0, 9.0, 0.3, 0.35))
        names = ("x", "y", "yaw", "score", "l", "w", "class")
        cars = [dict(zip(names, (*box, 4.5, 1.9, "car"), strict=True)) for box in boxes]
        tracks.append(tracker.update(cars, t=frame / RATE))
    return tracks, found


def row_of(tracks: optipmb.OnlineTracks, identity: int) -> int | None:
    """Return the row of a track, None where it is not there."""
    rows = np.flatnonzero(tracks.id == identity)
    return int(rows[0]) if len(rows) else None


def draw_track(axes: Axes, tracks: list[optipmb.OnlineTracks], found: list[tuple[int, float, float]]) -> None:
    """Draw the true path, detections and the track."""
    axes.plot(*np.array([place_of(k) for k in range(FRAMES)]).T, color=TRUTH, linewidth=5, label="true path")
    axes.plot(*np.array(found)[:, 1:].T, "x", color="#222222", markersize=4, label="detections")
    rows = [(one, row_of(one, 1)) for one in tracks]
    path = [one.center[i, :2] if i is not None else (np.nan, np.nan) for one, i in rows]
    axes.plot(*np.array(path).T, color=TRACK, linewidth=1.5, label="track 1")
    axes.annotate("a second without\ndetections", place_of(35), (8, 9), arrowprops={"arrowstyle": "->"}, fontsize=9)


def draw_ellipses(axes: Axes, tracks: list[optipmb.OnlineTracks], found: list[tuple[int, float, float]]) -> None:
    """Draw the ellipse of two standard deviations around the gap."""
    for frame in (24, 27, 29, 30, 31, 32, 40, 41, 44):
        one = tracks[frame]
        values, vectors = np.linalg.eigh(one.covariance[0, :2, :2])
        angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
        missed = frame in MISSED
        colour = GHOST if missed else CAR
        width, height = (4.0 * np.sqrt(values[::-1])).tolist()
        place = (float(one.center[0, 0]), float(one.center[0, 1]))
        label = {24: "after a detection", 30: "predicted"}.get(frame, "_")
        axes.add_patch(Ellipse(place, width, height, angle=angle, facecolor=colour, alpha=0.3, label=label))
        axes.plot(*place, ".", color=colour)
    near = np.array([(x, y) for frame, x, y in found if frame >= min(MISSED) - 8 and frame <= max(MISSED) + 6])
    axes.plot(*near.T, "x", color="#222222", markersize=4, label="detections")


def draw_existence(axes: Axes, tracks: list[optipmb.OnlineTracks]) -> None:
    """Draw the existence of the car and of the false detection."""
    ghost = next(int(i) for one in tracks for i in one.id if i != 1)
    for identity, colour, name in (
        (1, CAR, "car, missed from 3.0 s to 3.9 s"),
        (ghost, GHOST, "two false detections at one place"),
    ):
        rows = [row_of(one, identity) for one in tracks]
        values = [np.nan if i is None else one.existence[i] for one, i in zip(tracks, rows, strict=True)]
        axes.plot(np.arange(FRAMES) / RATE, values, color=colour, label=name)
    confirmed = optipmb.load_profile("generic").classes["car"].confirm_from
    axes.axhline(confirmed, color=TRUTH, linestyle="--", label="confirmed from here on")
    axes.set_ylim(0.0, 1.05)
    axes.set_xlabel("time (s)")
    axes.set_ylabel("existence")


def draw_zones(figure: Figure) -> None:
    """Draw two cars that pass a zone and a line, their events, and how many were inside."""
    zones = (Zone("yard", polygon=((6, -6), (20, -6), (22, 4), (8, 8))), Zone("gate", line=((14, -9), (15, 11))))
    tracker, state, inside, paths = optipmb.OnlineTracker("generic"), ZoneState(), [], {}
    axes, counts = figure.subplots(2, 1, height_ratios=(4, 1))
    labels = optipmb.load_profile("generic").labels
    for k in range(90):
        places = [(0.4 * k - 3, 0.5 * np.sin(k / 12) - 2, 0.0), (30 - 0.4 * (k - ENTERS), 5 - 0.03 * k, np.pi)]
        cars = [{"class": "car", "x": x, "y": y, "yaw": yaw, "score": 0.9} for x, y, yaw in places[: 1 + (k >= ENTERS)]]
        one = tracker.update([car | {"l": 4.5, "w": 1.9} for car in cars], t=k / RATE)
        state, events = observe(zones, state, k * 10**9 // RATE, one.tracks, labels)
        inside.append(sum(state.counts.get("yard", {}).get("inside", {}).values()))
        for i, identity in enumerate(one.id.tolist()):
            paths.setdefault(identity, []).append(one.center[i, :2])
        for event in events:
            x, y, _ = event.position
            axes.plot(x, y, "o", color=GHOST, markersize=5)
            text = f"{event.kind} {event.direction}".strip()
            axes.annotate(text, (x, y), (4, -13 if event.id == 1 else 6), textcoords="offset points", fontsize=8)
    axes.fill(*np.array(zones[0].polygon).T, color=TRUTH, alpha=0.3, label="zone yard")
    axes.plot(*np.array(zones[1].line).T, color="#222222", linewidth=2, label="line gate")
    for identity, path in paths.items():
        axes.plot(*np.array(path).T, color=CAR if identity == 1 else "#009E73", label=f"car {identity}")
    counts.step(np.arange(90) / RATE, inside, color=CAR, where="post")
    counts.set_ylabel("inside")
    counts.set_xlabel("time (s)")
    counts.set_yticks([0, 1, 2])
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    axes.legend(frameon=False, fontsize=8, loc="upper left", ncols=2)


def radar_of(session: optipmb.Parameters) -> optipmb.Parameters:
    """Return the profile of a radar: it misses half of the objects, by a metre and more."""
    document = session.model_dump(mode="json") | {"name": "radar"}
    for one in document["classes"].values():
        one["measurement_noise"] |= {"position": 1.5, "heading": 1.0}
        one |= {"detection": 0.5, "clutter_rate": 8.0, "gate": 5.0, "score_filter": 0.1, "reported_noise": None}
    return optipmb.parse_parameters(document)


def two_sensors(frames: int = 130) -> tuple[list[tuple[str, int, np.ndarray]], list[np.ndarray]]:
    """Return x, y, yaw and score of what a lidar and a radar detect by turns, and the paths of four cars."""
    rng, half = np.random.default_rng(4), np.pi / 2
    cars = ((0, -3.0, 9.0, 0.0), (25, 3.5, 8.0, np.pi), (10, -3.0, 7.0, half), (35, 3.5, 8.0, 0.0))
    found, paths = [], [[] for _ in cars]
    for k in range(2 * frames):
        is_radar, true = k % 2, []
        for (begins, aside, speed, yaw), path in zip(cars, paths, strict=True):
            along = speed * (k / 20 - begins / RATE) - 55.0
            x, y = along * np.cos(yaw) - aside * np.sin(yaw), along * np.sin(yaw) + aside * np.cos(yaw)
            if k / 2 < begins or along > 60.0:  # noqa: PLR2004 - end of the road, m
                continue
            path.append((x, y))
            seen = np.hypot(x, y) < 70 and abs(np.arctan2(y, x)) < 0.35 if is_radar else np.hypot(x, y) < 40  # noqa: PLR2004 - ranges, m, and half of the angle of the radar
            if seen and rng.random() < (0.6 if is_radar else 0.9):
                noise, turn = (1.2, 0.8) if is_radar else (0.12, 0.05)
                true.append((x + rng.normal(0, noise), y + rng.normal(0, noise), yaw + rng.normal(0, turn), 0.8))
        for _ in range(rng.poisson(1.0 if is_radar else 0.2)):
            angle, away = rng.uniform(-0.35, 0.35) * (1 if is_radar else 9), rng.uniform(5, 65 if is_radar else 40)
            true.append((away * np.cos(angle), away * np.sin(angle), rng.uniform(-3, 3), rng.uniform(0.2, 0.7)))
        found.append((("lidar", "radar")[is_radar], k * 10**9 // 20, np.array(true).reshape(-1, 4)))
    return found, [np.array(path) for path in paths]


def draw_fusion(figure: Figure) -> None:
    """Draw the tracks of a lidar and a radar, with one profile and with one for each."""
    found, paths = two_sensors()
    session = optipmb.load_profile("kitti")
    use = optipmb.Sensor(radar_of(session), starts_tracks=True, trust_size=False, trust_heading=False)
    views = {
        "lidar": optipmb.FieldOfView((-np.pi, np.pi), (-1.5, 1.5), (0, 40)),
        "radar": optipmb.FieldOfView((-0.35, 0.35), (-1.5, 1.5), (0, 70)),
    }
    pose = optipmb.Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    ways = (("one profile for both", optipmb.Sensors()), ("a profile for the radar", optipmb.Sensors((("*", use),))))
    for axes, (title, sensors) in zip(figure.subplots(2, 1, sharex=True), ways, strict=True):
        trackers = {"lidar": optipmb.Tracker(session), "radar": optipmb.Tracker(sensors.parameters(session, "radar"))}
        density, tracks = trackers["lidar"].initial(), {}
        for sensor, stamp_ns, boxes in found:
            columns = {
                "center": np.c_[boxes[:, :2], np.full(len(boxes), 0.8)],
                "yaw": boxes[:, 2],
                "score": boxes[:, 3],
            }
            columns |= {"label": np.zeros(len(boxes), int), "size": np.tile((4.5, 1.9, 1.6), (len(boxes), 1))}
            frame, _ = optipmb.make_frame(
                trackers[sensor].parameters,
                stamp_ns=stamp_ns,
                labels=("Car",),
                field_of_view=views[sensor],
                pose=pose,
                **columns,
            )
            result = trackers[sensor].step(density, frame)
            density = result.density
            for number, place, sure in zip(
                *(getattr(result.tracks, n) for n in ("id", "center", "confirmed")), strict=True
            ):
                if sure:
                    tracks.setdefault(int(number), []).append(place[:2])
        for path in paths:
            axes.plot(*path.T, color=TRUTH, linewidth=5, label="true path" if path is paths[0] else "_")
        for sensor, mark, colour in (("radar", "x", GHOST), ("lidar", ".", "#222222")):
            places = np.concatenate([boxes[:, :2] for name, _, boxes in found if name == sensor])
            axes.plot(*places.T, mark, color=colour, markersize=3, alpha=0.5, label=sensor)
        for place, path in enumerate(tracks.values()):
            axes.plot(*np.array(path).T, color=TRACK, linewidth=1.5, label="_" if place else "tracks")
        axes.set(title=title, aspect="equal", ylabel="y (m)", xlim=(-57, 72), ylim=(-26, 26))
    axes.set_xlabel("x (m)")
    axes.legend(frameon=False, fontsize=8, loc="lower left", ncols=4)


GATE: Final = {
    "image": [1920, 1080],
    "pinhole": {
        "intrinsics": [1050.0, 1050.0, 960.0, 540.0],
        "position": [0.0, 0.0, 6.0],
        "quaternion": [0.5, -0.5, 0.5, -0.5],
    },
}


def draw_camera(figure: Figure) -> None:
    """Draw the boxes of a street in the image of a camera, and their places on the ground with ellipses."""
    camera = optipmb.GroundCamera.parse(GATE)
    image, ground = figure.subplots(1, 2)
    unit = np.array(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [0.0, 1.0])).reshape(3, 8).T
    places = [(22, 6, "car"), (30, -4, "car"), (45, 4, "car"), (70, -6, "car"), (26, -9, "person"), (38, 10, "person")]
    boxes = []
    for x, y, name in places:
        size = (4.5, 1.9, 1.6) if name == "car" else (0.7, 0.7, 1.75)
        pixels = camera.project(unit * size + np.array([x, y, 0.0]))
        boxes.append(np.concatenate([pixels.min(axis=0), pixels.max(axis=0)]))
    found = camera.detections(boxes, [name for *_, name in places])
    for row, (center, spread) in enumerate(zip(found["center"], found["position_covariance"], strict=True)):
        colour = CAR if places[row][2] == "car" else GHOST
        x1, y1, x2, y2 = boxes[row]
        image.add_patch(Rectangle((x1, y1), x2 - x1, y2 - y1, fc="none", ec=colour))
        values, axes = np.linalg.eigh(spread[:2, :2])
        width, height = 2.0 * np.sqrt(5.99 * values)
        angle = float(np.degrees(np.arctan2(axes[1, 0], axes[0, 0])))
        ground.add_patch(Ellipse(center[:2], width, height, angle=angle, fc=f"{colour}33", ec=colour))
        ground.plot(*places[row][:2], "+", color=colour)
    view = camera.field_of_view
    if view is not None:
        turn = np.linspace(*view.azimuth, 50)
        arcs = [np.array([np.cos(turn), np.sin(turn)]) * reach for reach in view.range]
        ground.plot(*np.hstack([arcs[0], arcs[1][:, ::-1], arcs[0][:, :1]]), color=TRUTH)
    image.axhline(camera.project([[1e6, 0.0, 0.0]])[0, 1], color=TRUTH, lw=0.8)
    image.set(xlim=(0, 1920), ylim=(1080, 0), aspect="equal", xlabel="u (px)", ylabel="v (px)", title="boxes, horizon")
    limits = {"xlim": (0, 85), "ylim": (-40, 40)}
    ground.set(**limits, aspect="equal", xlabel="x (m)", ylabel="y (m)", title="places, 95 % ellipses, field of view")


def draw_runs(folder: Path) -> None:
    """Draw the demonstration and the crossing by the commands of the pages."""
    examples = Path(__file__).parent.parent / "examples"
    crossing = [f"{examples}/crossing.csv"]
    truth = ["--truth", f"{examples}/crossing_truth.csv"]
    scene = ["--dataset", "scene", "--option", "seed=4", "--option", "frames=90"]
    with tempfile.TemporaryDirectory() as place:
        for data, known, name in ((scene, [], "demo.gif"), (crossing, truth, "getting-started.png")):
            tracks = f"{place}/{name}.csv"
            run(["track", *data, "--out", tracks])
            run(["plot", *data, *known, "--tracks", tracks, "--out", f"{folder / name}"])


def behind_a_building(path: Path) -> None:
    """Write a table of the detections of a car that a building hides, and of people who appear meanwhile."""
    rng, rows = np.random.default_rng(5), ["t,x,y,l,w,yaw,score,class"]
    for k in range(130):
        boxes = [(2.0 + 6.0 * n, 11.0, 0.0) for n in range(7) if k >= max(0, 12 * (n - 1))]
        if k >= 5 and not HIDDEN[0] < CAR_SPEED * k / RATE < HIDDEN[1]:  # noqa: PLR2004 - its first frame
            boxes.append((CAR_SPEED * k / RATE, 5.0, 1.0))
        for x, y, is_car in boxes:
            name = "4.5,1.9,0.0,0.9,car" if is_car else "0.7,0.6,1.6,0.9,pedestrian"
            rows.append(f"{k / RATE},{x + rng.normal(0.0, 0.08)},{y + rng.normal(0.0, 0.08)},{name}")
    path.write_text("\n".join(rows) + "\n")


CAR_SPEED = 4.5
HIDDEN = (18.5, 40.7)
"""x between which the building of the picture hides the car."""


def draw_gap(axes: Axes) -> None:
    """Draw the tracks of a car before and behind a building, and where it could have been."""
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "boxes.csv"
        behind_a_building(table)
        (sequence,) = open_dataset("table", table).sequences(["all"])
        parameters = profiles.profile_for("auto", [sequence])
        tracks = track_whole(Tracking(parameters), sequence).tracks
    found, objects = tracklets(tracks, parameters.labels), RejoinOptions().objects(tracks, parameters)
    object_of = dict(zip(objects.id.tolist(), objects.object.tolist(), strict=True))
    earlier, later = np.flatnonzero([parameters.labels[one] == "car" for one in found.label.tolist()]).tolist()
    ends = found.take(np.array([earlier]))
    seconds = float(found.first_ns[later] - ends.last_ns[0]) * 1e-9
    x, y = np.meshgrid(np.arange(0.0, 62.0, 0.25), np.arange(-18.0, 16.0, 0.25))
    way, variance = tuple(ends.end_velocity[0].tolist()), float(ends.end_variance[0])
    here, unknown, car = ends.end[0].tolist(), (np.nan, np.nan), np.array(motion_of("car"))
    scores = [
        motion_score((one - here[0], two - here[1]), way, variance, unknown, np.nan, seconds, car)
        for one, two in zip(x.ravel().tolist(), y.ravel().tolist(), strict=True)
    ]
    density = np.exp(scores).reshape(x.shape)
    axes.contourf(
        x,
        y,
        density,
        levels=density.max() * np.array((0.02, 0.1, 0.3, 1.0)),
        colors=[(CAR, 0.12), (CAR, 0.22), (CAR, 0.35)],
    )
    axes.add_patch(Rectangle((22.0, -2.0), 14.0, 4.0, color=TRUTH, label="building"))
    axes.annotate("where it may be when\nit is seen again", (44.0, 10.0), (44.0, 10.8), fontsize=9)
    axes.plot(28.0, -14.0, "^", color="#222222", label="sensor")
    for edge in HIDDEN:
        axes.plot((28.0, edge), (-14.0, 5.0), ":", color=TRUTH)
    for identity, label in zip(found.id.tolist(), found.label.tolist(), strict=True):
        path = [one.center[one.id == identity, :2][0] for one in tracks.values() if identity in one.id]
        is_car = parameters.labels[label] == "car"
        axes.plot(*np.array(path).T, color=CAR if is_car else "#009E73", linewidth=2)
        text = f"id {identity}, object {object_of[identity]}" if is_car else f"{identity}"
        axes.annotate(
            text, path[len(path) // 2], (0, -14 if is_car else 6), textcoords="offset points", ha="center", fontsize=9
        )
    axes.plot(*np.column_stack((ends.end[0], found.begin[later])), color=CAR, linewidth=0.8)


def draw_places(figure: Figure) -> None:
    """Draw parked cars whose detections drop out, and people at declared doors and behind a pillar."""
    parameters = optipmb.generic_parameters(gaps.CLASSES, 0.1)
    park, wall = figure.subplots(1, 2, width_ratios=(58, 44))
    for axes, scene, seconds in ((park, "car park", 120.0), (wall, "doors", 40.0)):
        recording, declared = gaps.record(scene, 31, seconds), gaps.DECLARED.get(scene, {})
        frames = (optipmb.make_frame(parameters, **one)[0] for one in recording.frames)
        paths: dict[int, dict[int, list[np.ndarray]]] = {}
        parked: list[np.ndarray] = []
        for one in gaps.followed(frames, parameters, optipmb.Rejoin(**declared)).values():
            columns = one.object.tolist(), one.id.tolist(), one.center[:, :2], one.detection.tolist()
            for number, identity, place, detection in zip(*columns, strict=True):
                if number >= 0 and detection >= 0:
                    paths.setdefault(number, {}).setdefault(identity, []).append(place)
        for polygon in declared.get("exits", ()):
            axes.add_patch(Polygon(polygon, color=GHOST, alpha=0.25, label="exit"))
        for tracks in paths.values():
            ways = [np.array(way) for way in tracks.values()]
            if axes is park and np.ptp(ways[0], axis=0).max() < STANDS_M:
                axes.add_patch(Rectangle(ways[0][0] - (1.0, 2.2), 2.0, 4.4, color=CAR, alpha=0.3))
                aside = next((one for one in parked if np.linalg.norm(one - ways[0][0]) < STANDS_M), None)
                place = ways[0][0] + (0.0, 0.8 if aside is None else -0.8)
                axes.annotate(str(len(ways)), place, ha="center", va="center", fontsize=8)
                parked.append(ways[0][0])
                continue
            for way in ways:
                axes.plot(*way.T, color=TRUTH if axes is park else CAR, linewidth=1)
                axes.plot(*way[0], "o", color=CAR, markersize=3, fillstyle="none")
            for before, after in itertools.pairwise(ways):
                axes.plot(*np.column_stack((before[-1], after[0])), ":", color=GHOST, linewidth=1.2)
        axes.set(aspect="equal", xlabel="x (m)", ylabel="y (m)")
    park.set(title="ids of each parked car, which is one object", xlim=(-30, 29), ylim=(0, 30))
    wall.add_patch(Rectangle((-0.7, 5.0), 1.4, 1.0, color=TRUTH, label="pillar"))
    wall.set(title="doors: none who comes out went in", xlim=(-22, 22), ylim=(2, 15))


STANDS_M = 2.0
"""Places of a parked car lie nearer together."""


def draw_links(figure: Figure) -> None:
    """Draw the tracks of two sites with frames of their own, and in one plane with the common ids."""
    world = plaza(11, 10.0, objects=10, half=(26.0, 14.0))
    views = View("garage/n/lidar", circle(-10.0, 0.0, 20.0)), View("yard/n/lidar", circle(10.0, 0.0, 20.0))
    frames = {"garage": WorldFrame(), "yard": WorldFrame(0, 30.0, -6.0, np.pi / 2)}
    linker = Linker("campus", LinkSettings(streams=("*/*/*",)), lambda stream: frames[stream.partition("/")[0]])
    streams = [
        [one.model_copy(update={"id": one.id + 20 * number}) for one in copied(world, view, 1)]
        for number, view in enumerate(views)
    ]
    paths: dict[tuple[str, int], list[np.ndarray]] = {}
    for together in zip(*streams, strict=True):
        for one in together:
            frame = frames[one.stream.partition("/")[0]]
            back = frame._replace(yaw=-frame.yaw)
            own = back.turned(one.center[:, :2] - (frame.x, frame.y))
            moved = {"center": np.column_stack((own, one.center[:, 2])), "velocity": back.turned(one.velocity)}
            linker.take(one.model_copy(update=moved), one.stamp_ns)
            for identity, place in zip(one.id.tolist(), own, strict=True):
                paths.setdefault((one.stream, identity), []).append(place)
    ids = {(row.stream, row.object): row.global_id.hex()[:4] for row in linker.rows()}
    known = sorted(set(ids.values()))
    garage, yard, both = figure.subplots(1, 3, width_ratios=(1.0, 0.8, 1.5))
    for (stream, identity), places in paths.items():
        name = ids.get((stream, identity))
        colour = TRUTH if name is None else LINKED[known.index(name) % len(LINKED)]
        frame = frames[stream.partition("/")[0]]
        own, side = np.array(places), yard if stream.startswith("yard") else garage
        common = frame.turned(own) + np.array((frame.x, frame.y))
        side.plot(*own.T, color=colour, linewidth=1.2)
        side.annotate(str(identity), own[-1], fontsize=8, color="#333333")
        both.plot(*common.T, color=colour, linewidth=1.2, linestyle="--" if side is yard else "-")
        if name and side is garage:
            both.annotate(name, common[-1], fontsize=8, color="#333333")
    for axes, text in ((garage, "garage"), (yard, "yard: its own world frame"), (both, "one plane, common ids")):
        axes.set_title(text, fontsize=10)
        axes.set(aspect="equal", xlabel="x (m)")
        axes.grid(visible=True, color="#EEEEEE")
    garage.set_ylabel("y (m)")


def main(folder: Path) -> None:
    """Write the pictures into a folder."""
    draw_runs(folder)
    figure = Figure(figsize=(7.5, 6.4), layout="constrained")
    FigureCanvasAgg(figure)
    draw_fusion(figure)
    figure.savefig(folder / "fusion.png", dpi=100, metadata={"Software": None})
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    draw_gap(axes)
    axes.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", xlim=(-1, 61), ylim=(-17, 15))
    axes.legend(frameon=False, fontsize=9, loc="lower left")
    figure.savefig(folder / "gaps.png", dpi=110, metadata={"Software": None})
    figure = Figure(figsize=(10.0, 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    draw_places(figure)
    figure.savefig(folder / "gaps-places.png", dpi=110, metadata={"Software": None})
    tracks, found = scene()
    figure = Figure(figsize=(6.0, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    draw_zones(figure)
    figure.savefig(folder / "zones.png", dpi=110, metadata={"Software": None})
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    draw_camera(figure)
    figure.savefig(folder / "cameras.png", dpi=100, metadata={"Software": None})
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    draw_links(figure)
    figure.savefig(folder / "links.png", dpi=100, metadata={"Software": None})
    for name, size in (("track", (6.0, 4.2)), ("ellipse", (6.0, 4.2)), ("existence", (6.0, 3.0))):
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots()
        if name == "existence":
            draw_existence(axes, tracks)
        else:
            (draw_track if name == "track" else draw_ellipses)(axes, tracks, found)
            axes.set_aspect("equal")
            axes.set_xlabel("x (m)")
            axes.set_ylabel("y (m)")
        axes.grid(visible=True, color="#EEEEEE")
        axes.legend(frameon=False, fontsize=9)
        figure.savefig(folder / f"concepts-{name}.png", dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    main(Path(sys.argv[1]))
