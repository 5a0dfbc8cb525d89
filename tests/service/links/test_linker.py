"""Links between streams: the pure part."""

import dataclasses
import random
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from optipmb_schemas import Tracks, decode, encode, encoding_of
from optipmb_service.links.linker import Linker
from optipmb_service.links.looks import LinkInputs
from optipmb_service.links.places import WorldFrame
from optipmb_service.settings import LinkSettings
from sites import BEGIN_NS, RATE, View, World, circle, copied, corridor, plaza
from tracks_message import tracks_message

WEST = View("site/west/lidar", circle(-15.0, 0.0, 40.0))
EAST = View("site/east/lidar", circle(15.0, 0.0, 40.0))


def together(*streams: list[Tracks]) -> list[Tracks]:
    return [one for frame in zip(*streams, strict=True) for one in frame]


def area(frame: Callable[[str], WorldFrame] = lambda _: WorldFrame(), **settings: Any) -> Linker:
    return Linker("area", LinkSettings(streams=("*/*/*",), **settings), frame)


def again(state: bytes) -> Linker:
    new = area()
    return Linker.restored(new.area, new.settings, new.inputs.frame, state)


def run(messages: list[Tracks], linker: Linker | None = None) -> Linker:
    linker = linker or area()
    for one in messages:
        linker.take(one, one.stamp_ns)
    return linker


def ids(linker: Linker) -> dict[tuple[str, int], bytes]:
    return {(row.stream, row.object): row.global_id for row in linker.rows()}


def common(world: World) -> list[int]:
    """Return the objects that both streams have seen for the last two seconds."""
    place = world.place[-20:].reshape(-1, 2)
    found: list[int] = np.flatnonzero((WEST.inside(place) & EAST.inside(place)).reshape(20, -1).all(axis=0)).tolist()
    assert len(found) > 15
    return found


def line(
    speed: float, *, seconds: float = 30.0, x: float = 0.0, y: float = 0.0, label: int = 1, turn: float = 0.0
) -> World:
    """Return one object on a straight line along x, which goes along y from half the time on with `turn` m/s."""
    time = np.arange(round(seconds * RATE)) / RATE
    place = np.column_stack((x + speed * time, y + turn * np.maximum(time - 0.5 * seconds, 0.0)))
    return World(np.array([label]), place[:, None])


def beside(*worlds: World) -> World:
    return World(np.concatenate([one.label for one in worlds]), np.concatenate([one.place for one in worlds], axis=1))


@pytest.fixture(scope="module")
def site() -> tuple[World, list[Tracks]]:
    world = plaza(3, 12.0)
    east = dataclasses.replace(EAST, shift=(0.4, -0.3), turn=np.radians(1.0), late=0.1)
    return world, together(copied(world, WEST, 3), copied(world, east, 3))


def test_tracks_in_the_plane_of_the_area() -> None:
    """Places, velocities and covariances of a world frame are turned and moved as the matrices say."""
    rng, yaw, count = np.random.default_rng(0), 0.7, 20
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    factor = rng.standard_normal((count, 6, 6))
    covariance = factor @ factor.transpose(0, 2, 1) + 0.1 * np.eye(6)
    center, velocity = rng.uniform(-50, 50, (count, 3)), rng.uniform(-9, 9, (count, 2))
    columns = {"center": center, "velocity": velocity, "covariance": covariance}
    message = tracks_message("a/n/s", 0, list(range(count)), stamp_ns=BEGIN_NS, confirmed=1, **columns)
    inputs = LinkInputs(lambda _: WorldFrame(x=3.0, y=-4.0, yaw=yaw))
    stream = inputs.accept(message, BEGIN_NS, -1)
    assert stream is not None
    inputs.add(stream, message, None)
    look = stream.looks[-1]
    np.testing.assert_allclose(look.place, message.center[:, :2] @ turn.T + (3.0, -4.0))
    np.testing.assert_allclose(look.velocity, message.velocity @ turn.T, rtol=1e-5)
    wanted = turn @ message.covariance[:, :2, :2] @ turn.T
    np.testing.assert_allclose(look.covariance, wanted[:, [0, 0, 1], [0, 1, 1]], rtol=1e-4, atol=1e-6)


def test_overlap(site: tuple[World, list[Tracks]]) -> None:
    """Tracks of common objects get one id, and others none, where a stream is off by .5 m, 1 degree and 100 ms."""
    world, messages = site
    linker = run(messages)
    found = ids(linker)
    for (stream, one), identity in found.items():
        assert {other for (_, other), own in found.items() if own == identity} == {one}, stream
    for one in common(world):
        assert found["site/west/lidar", one] == found["site/east/lidar", one]
    bias = linker.biases[0]
    assert np.degrees(bias["estimate"][2]) == pytest.approx(-1.0, abs=0.2)
    assert bias["estimate"][3] == pytest.approx(0.1, abs=0.02)


def test_state_goes_on(site: tuple[World, list[Tracks]]) -> None:
    """A linker that is restored at any message ends with the bytes of one that went on."""
    _, messages = site
    whole = run(messages)
    for cut in (1, 17, 118):
        part = run(messages[:cut])
        rows, changes = part.rows(), part.changes()
        part = again(part.state())
        assert part.rows() == rows
        run(messages[cut:], part)
        assert part.state() == whole.state()
        assert changes + part.changes() == run(messages).changes()


def test_state_refused() -> None:
    """A state of another version, and bytes that are none, are refused."""
    for state in (b"", b"\x81", area().state()[:-3], b"\x95\x07" + area().state()[2:]):
        with pytest.raises(ValueError, match="state of links"):
            again(state)


def test_disorder(site: tuple[World, list[Tracks]]) -> None:
    """Messages that come twice, or in another order within a second, change no link."""
    world, messages = site
    mixed, rng = [*messages[:2]], random.Random(1)
    for at in range(2, len(messages), 8):
        part = messages[at : at + 8] * 2
        rng.shuffle(part)
        mixed += part
    one, other = run(messages), run(mixed)
    for linker in (one, other):
        found = ids(linker)
        assert all(found["site/west/lidar", n] == found["site/east/lidar", n] for n in common(world))
    assert other.inputs.counters["repeated"] + other.inputs.counters["late"] > 50


@pytest.mark.parametrize("off_s", [-3600.0, 3600.0, 5.0])
def test_wrong_clock(off_s: float, site: tuple[World, list[Tracks]]) -> None:
    """A stream whose clock is wrong is named and left out; the links of the others do not change."""
    world, messages = site
    third = [
        one.model_copy(update={"stamp_ns": one.stamp_ns + round(off_s * 1e9)})
        for one in copied(world, View("site/wrong/lidar", circle(0.0, 0.0, 40.0)), 3)
    ]
    linker = area()
    for n, one in enumerate(messages):
        linker.take(one, one.stamp_ns)
        if n % 2:
            linker.take(third[n // 2], one.stamp_ns)
    assert ids(linker) == ids(run(messages))
    assert "stamps are" in linker.inputs.problems["site/wrong/lidar", "wrong_clock"]


@pytest.mark.parametrize("off_s", [-3600.0, 3600.0, 4e9])
def test_wrong_clock_is_there_first(off_s: float, site: tuple[World, list[Tracks]]) -> None:
    """A stream with a wrong clock that is there before the others does not keep them from being linked."""
    world, messages = site
    wrong = copied(world, View("site/wrong/lidar", circle(0.0, 0.0, 40.0)), 3)
    linker = area()
    for n, one in enumerate(wrong):
        stamp_ns = one.stamp_ns + round(off_s * 1e9)
        linker.take(one.model_copy(update={"stamp_ns": stamp_ns}), one.stamp_ns)
        for other in messages[2 * n : 2 * n + 2] if n >= 10 else ():
            linker.take(other, one.stamp_ns)
    found = ids(linker)
    assert all(found["site/west/lidar", n] == found["site/east/lidar", n] for n in common(world))
    assert ("site/wrong/lidar", "wrong_clock") in linker.inputs.problems


def test_one_wrong_stamp(site: tuple[World, list[Tracks]]) -> None:
    """One stamp that is far ahead is left out, named, and changes no link."""
    world, messages = site
    linker = run(messages[:120])
    odd = messages[120].model_copy(update={"stamp_ns": 2**62})
    linker.take(odd, messages[120].stamp_ns)
    assert (odd.stream, "wrong_clock") in linker.inputs.problems
    run(messages[121:], linker)
    found = ids(linker)
    assert all(found["site/west/lidar", n] == found["site/east/lidar", n] for n in common(world))


@pytest.mark.parametrize("seconds", [13, 20])
def test_clocks_set_back(seconds: int, site: tuple[World, list[Tracks]]) -> None:
    """Streams whose clocks are all set back are linked again, after their earlier objects have ended."""
    world, messages = site
    linker = run(messages)
    before = {row.global_id for row in linker.rows() if not row.ended}
    linker.changes()
    later = seconds * 10**9
    for one in messages:
        earlier = one.model_copy(update={"stamp_ns": one.stamp_ns - 3600 * 10**9, "session": "2" * 32})
        linker.take(earlier, one.stamp_ns + later)
    found, ended = ids(linker), {row.global_id for row in linker.changes() if row.ended}
    assert all(found["site/west/lidar", n] == found["site/east/lidar", n] for n in common(world))
    assert ended >= before
    assert [("", "set_back") in linker.wrong() for _ in range(2)] == [True, False]


def test_swapped_frames(site: tuple[World, list[Tracks]]) -> None:
    """World frames that were taken for each other link no objects."""
    _, messages = site
    frames = {"site/west/lidar": WorldFrame(0, 30.0, -20.0, 1.5), "site/east/lidar": WorldFrame(0, -10.0, 25.0, -0.7)}
    assert run(messages, area(frames.__getitem__)).rows() == []


def hostile(n: int) -> dict[str, Any]:
    """Return columns at the bounds of `Tracks`."""
    far = np.array([[1e9, -1e9, 0.0], [0.0, 0.0, 0.0], [5.0, 5.0, 0.0]])
    return (
        {"center": far, "velocity": np.full((3, 2), 1e5)},
        {"covariance": np.zeros((3, 6, 6)), "time_since_detection": np.full(3, 1e12)},
        {"covariance": np.full((3, 6, 6), -1e30), "age": np.full(3, 1e12)},
        {"covariance": np.full((3, 6, 6), 1e30), "size": np.full((3, 3), 1e-300)},
        {"object": np.array([2**53 - 1, 0, 1]), "object_probability": np.ones(3)},
        {"object": np.array([7, 7, -1]), "object_probability": np.ones(3)},
        {"labels": [f"c{k}" for k in range(200)], "label": np.array([0, 100, 199])},
    )[n % 7]


def test_hostile_values(site: tuple[World, list[Tracks]]) -> None:
    """Tracks with all values at their bounds change no link of other streams; the state stays readable."""
    world, messages = site
    linker = area()
    for n, one in enumerate(messages):
        linker.take(one, one.stamp_ns)
        odd = tracks_message("site/odd/lidar", n, [0, 1, 2**62], stamp_ns=one.stamp_ns, confirmed=1, **hostile(n // 10))
        linker.take(decode(encode(odd), Tracks, encoding=encoding_of(odd)), one.stamp_ns)
    found = ids(linker)
    assert all(found["site/west/lidar", n] == found["site/east/lidar", n] for n in common(world))
    assert again(linker.state()).rows() == linker.rows()


def test_parting() -> None:
    """The link of two who walk side by side, each seen by one stream, is withdrawn when they part: one has a new id."""
    pair = beside(line(1.0, y=-0.15), line(1.0, y=0.15, turn=2.0))
    west = copied(World(pair.label[:1], pair.place[:, :1]), WEST, 1)
    east = copied(World(pair.label[1:], pair.place[:, 1:]), EAST, 1)
    linker, seen = area(), []
    for one in together(west, east):
        linker.take(one, one.stamp_ns)
        seen.append(len(linker.rows()))
    assert max(seen[:300]) == 2
    assert seen[-1] == 0
    told = [row for row in linker.changes() if row.kind == "none" and not row.ended]
    assert len({row.global_id for row in told}) == 1


def test_parting_after_a_third_view() -> None:
    """Two who part are two objects also where both are linked to a track of a third stream that has ended."""
    pair = beside(line(1.0, y=-0.15), line(1.0, y=0.15, turn=2.0))
    first = World(pair.label[:1], pair.place[:, :1])
    west = copied(first, WEST, 1)
    east = copied(World(pair.label[1:], pair.place[:, 1:]), EAST, 1)
    third = copied(first, View("site/third/lidar", WEST.inside), 1, frames=range(150))
    linker = run(sorted([*west, *east, *third], key=lambda one: one.stamp_ns))
    found = ids(linker)
    assert found.get(("site/west/lidar", 0), b"0") != found.get(("site/east/lidar", 0), b"1")


def test_session_restarts() -> None:
    """An object keeps its id while a stream that sees it begins another session."""
    world = plaza(5, 16.0, objects=12)
    old, new = copied(world, EAST, 1), copied(world, EAST, 2, session="1" * 32)
    new = [one.model_copy(update={"id": one.id + 100}) for one in new]
    linker = run(together(copied(world, WEST, 1), [*old[:80], *new[80:]]))
    found: dict[bytes, set[tuple[str, int]]] = {}
    for row in linker.rows():
        found.setdefault(row.global_id, set()).add((row.session, row.object % 100))
    assert any(len(one) == 3 or {session for session, _ in one} == {"0" * 32, "1" * 32} for one in found.values())
    assert all(len({number for _, number in one}) == 1 for one in found.values())


def test_off_for_ten_minutes() -> None:
    """A site that was off for ten minutes is linked as before when it is back."""
    world = plaza(7, 610.0, objects=4, half=(12.0, 12.0))
    before, after = range(50), range(6050, 6100)
    linker = run(together(copied(world, WEST, 1, frames=before), copied(world, EAST, 1, frames=before)))
    run(copied(world, WEST, 1, frames=range(50, 6050, 5)), linker)
    run(together(copied(world, WEST, 1, frames=after), copied(world, EAST, 1, frames=after)), linker)
    found = ids(linker)
    assert all(found["site/west/lidar", n] == found["site/east/lidar", n] for n in range(4))


@pytest.fixture(scope="module")
def walks() -> list[Tracks]:
    """Return tracks of people who leave one view and come into the next one, to and fro."""
    world = corridor(2, objects=25, every=40.0)
    views = (View("a/n/s", lambda p: p[:, 0] < 0.0), View("b/n/s", lambda p: p[:, 0] > 20.0))
    messages = []
    for number, view in enumerate(views):
        tracks = copied(world, view, 2, frames=range(0, len(world.place), 2))
        messages.append([one.model_copy(update={"id": one.id + 1000 * number}) for one in tracks])
    return together(*messages)


@pytest.mark.parametrize("planes", [0, 1])
def test_passages_are_learned(planes: int, walks: list[Tracks]) -> None:
    """Objects that pass from view to view keep their id, also where nobody knows how the world frames lie."""
    linker = area(lambda stream: WorldFrame(plane=planes if stream == "b/n/s" else 0))
    linked = set()
    for one in walks:
        linker.take(one, one.stamp_ns)
        linked |= {(row.stream, row.object % 1000, row.global_id) for row in linker.changes() if row.kind == "passage"}
    by_id: dict[bytes, set[int]] = {}
    for _, number, identity in linked:
        by_id.setdefault(identity, set()).add(number)
    assert all(len(one) == 1 for one in by_id.values())
    assert len(by_id) >= (15 if planes == 0 else 5)


def test_vectors_tell_people_apart() -> None:
    """People who come back elsewhere, in another order, are linked by vectors that overlapping views have taught."""
    rng, people = np.random.default_rng(2), 6
    vectors = np.random.default_rng(1).standard_normal((people, 32))
    lanes = np.column_stack((np.zeros(people), 6.0 * np.arange(people), np.ones(people)))
    passage = {"from": "*/*/*", "to": "site/west/*", "s": (4.0, 20.0)}
    linker = area(embedding_model="reid", min_probability=0.9, passages=(passage,))

    def look(stream: str, n: int, first: int, place: np.ndarray, looks: np.ndarray) -> None:
        message = tracks_message(
            stream,
            n,
            list(range(first, first + len(place))),
            stamp_ns=BEGIN_NS + n * 10**8,
            center=place + 0.05 * rng.standard_normal(place.shape),
            covariance=0.01 * np.eye(6),
            age=0.1 * (n - 480 * (first > 0)),
            labels=["pedestrian"],
            confirmed=1,
        )
        noise = 0.1 * rng.standard_normal((len(place), 32))
        linker.take(message, message.stamp_ns, (looks[: len(place)] + noise).astype(np.float32) if n % 5 == 0 else None)

    for n in range(560):
        back = n >= 480
        west = lanes + np.array((12.0, 3.0, 0.0)) if back else lanes[: people * (n < 400)]
        look("site/west/lidar", n, 10 * back, west, vectors[::-1] if back else vectors)
        look("site/east/lidar", n, 0, lanes[: people * (n < 400)], vectors)
    found = {(row.object, row.kind): row.global_id for row in linker.rows() if row.stream == "site/west/lidar"}
    again = [number for number, kind in found if kind == "appearance"]
    assert len(again) >= people // 2
    assert all(found[number, "appearance"] == found[10 + people - 1 - number, "overlap"] for number in again)


def test_exit(walks: list[Tracks]) -> None:
    """Nothing that ended at an exit comes back anywhere."""
    door = {"streams": "a/*/*", "polygon": ((-4.0, -5.0), (2.0, -5.0), (2.0, 5.0), (-4.0, 5.0))}
    passage = {"from": "a/*/*", "to": "b/*/*", "s": (10.0, 20.0)}
    linker = run(walks, area(passages=(passage,), exits=(door,)))
    assert linker.rows() == []


def test_many() -> None:
    """A thousand objects, and many tracks at one place, are bounded and named."""
    rng = np.random.default_rng(0)
    place = np.column_stack((rng.uniform(-200, 200, (1000, 2)), np.zeros(1000)))
    linker = area(most=1500)
    for n in range(8):
        for stream, offset, session in (("a/n/s", 0, n // 4), ("b/n/s", 1, n // 4)):
            linker.take(
                tracks_message(
                    stream,
                    n,
                    list(range(1000)),
                    stamp_ns=BEGIN_NS + n * 200_000_000 + offset,
                    center=place + 0.1 * rng.standard_normal((1000, 1)),
                    covariance=0.01 * np.eye(6),
                    session=f"{session:032d}",
                    confirmed=1,
                ),
                BEGIN_NS + n * 200_000_000,
            )
    assert len(linker.objects.table) <= 1500 + 1000
    assert ("", "too_many_objects") in linker.inputs.problems
    crowd = area()
    for n in range(4):
        for stream in ("a/n/s", "b/n/s"):
            crowd.take(
                tracks_message(stream, n, list(range(2500)), stamp_ns=BEGIN_NS + n * 200_000_000, confirmed=1),
                BEGIN_NS + n * 200_000_000,
            )
    assert {code for _, code in crowd.inputs.problems} == {"crowded", "too_many_tracks"}
    assert crowd.rows() == []
    assert len(crowd.pairs) == 0
