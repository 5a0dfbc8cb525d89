"""`Subscribe` and `QueryTracks`: the selected tracks, in order; a slow reader delays no other."""

import asyncio
from collections.abc import Iterable
from typing import Any

import grpc
import numpy as np
import pytest
from gateway import DEADLINES, GatewayProcess, detections, frame, resident
from grpc_status import rpc_status
from optipmb_schemas import Tracks, encode
from optipmb_schemas.protobuf import convert
from optipmb_schemas.protobuf import tracking_pb2 as pb
from optipmb_schemas.protobuf import tracking_pb2_grpc as rpc
from optipmb_service.edges.grpc.selection import Filter
from proxy import Proxy
from service_process import ServiceProcess

SUBSCRIBERS = 200
FRAMES = 20

SUBSCRIBER_BYTES = 512 * 2**10
"""Memory that the gateway may take for each of many subscribers."""


def tracked(stub: Any, stream: str, frames: Iterable[int] = range(30)) -> list[Any]:
    return [one.tracks for one in stub.Track(detections(frame(seq, stream)) for seq in frames)]


def subscribed(stub: Any, **asked: Any) -> Any:
    call = stub.Subscribe(pb.SubscribeRequest(**asked))
    call.initial_metadata()
    return call


def taken(call: Any, number: int) -> list[Any]:
    """The next responses of a subscription, which then ends."""
    responses = [next(call) for _ in range(number)]
    call.cancel()
    return responses


def test_tracks_come_as_they_are_published(stub: Any, stream: str) -> None:
    """A subscription to a pattern gets every frame once, byte-equal to what its publisher gets back."""
    site, node, _ = stream.split("/")
    call = subscribed(stub, pattern=f"{site}/{node}/*", queue=1024)
    published = tracked(stub, stream)
    received = [one.tracks for one in taken(call, 30)]
    assert received == published


def test_history_comes_first_and_once(stub: Any, stream: str) -> None:
    """With history a late subscriber first gets the tracks that are kept, then new ones, without repetition."""
    tracked(stub, stream, range(20))
    call = subscribed(stub, pattern=stream, history=True)
    early = [next(call).tracks.seq for _ in range(20)]
    tracked(stub, stream, range(20, 30))
    assert early + [one.tracks.seq for one in taken(call, 10)] == list(range(30))


def test_without_history_only_new_frames_come(stub: Any, stream: str) -> None:
    """Without it the first frame is one that was published afterwards."""
    tracked(stub, stream, range(20))
    call = subscribed(stub, pattern=stream)
    tracked(stub, stream, range(20, 30))
    assert taken(call, 1)[0].tracks.seq == 20


def test_the_first_tracks_of_a_subscription_in_force_come(service: ServiceProcess, stub: Any, stream: str) -> None:
    """Through a gateway that is far from the service, too."""
    with Proxy(service.endpoint, delay_s=0.05) as far, GatewayProcess(far.endpoint) as gateway:
        gateway.wait_ready()
        call = subscribed(gateway.stub(), pattern=stream)
        tracked(stub, stream, range(3))
        assert [one.tracks.seq for one in taken(call, 3)] == [0, 1, 2]


def test_attributes_go_with_their_tracks() -> None:
    """A filter keeps the attributes of the chosen tracks, by their new rows, and none where only columns are asked."""
    proto = pb.Tracks(labels=["car", "pedestrian"])
    for name, values in (("label", np.array([0, 1])), ("existence", np.ones(2)), ("age", np.ones(2))):
        getattr(proto, name).CopyFrom(
            pb.Array(shape=[2], data=values.tobytes(), dtype=convert.DTYPE_CODES[values.dtype.str[1:]])
        )
    proto.attributes.extend(pb.Attribute(row=row, name="plate", text=text) for row, text in enumerate("AB"))
    chosen = Filter(pb.TrackFilter(classes=["pedestrian"])).of(proto)
    assert [(one.row, one.text) for one in chosen.attributes] == [(0, "B")]
    assert [one.row for one in proto.attributes] == [0, 1]
    assert not Filter(pb.TrackFilter(fields=["label"])).of(proto).attributes


def test_filters(stub: Any, stream: str) -> None:
    """Classes, confirmation, an area and columns are chosen by the gateway; the rest is unchanged."""
    answers = [convert.from_proto(one, Tracks) for one in tracked(stub, stream)]

    def last(**chosen: Any) -> Any:
        responses = stub.QueryTracks(pb.QueryTracksRequest(pattern=stream, filter=pb.TrackFilter(**chosen)))
        return [one.tracks for one in responses][-1]

    def centers(tracks: Any) -> Any:
        return np.frombuffer(tracks.center.data).reshape(-1, 3)

    full = convert.from_proto(last(), Tracks)
    assert full.seq == max(one.seq for one in answers) == 29
    # On a busy machine a frame may come late and correct the newest one, which has been answered before.
    assert {(one.seq, one.revision): one for one in answers}.get((full.seq, full.revision), full) == full
    (row,) = np.flatnonzero(full.label == full.labels.index("pedestrian"))
    assert (centers(last(classes=["pedestrian"])) == full.center[[row]]).all()
    assert list(last(classes=["bus"]).id.shape) == [0]
    assert (centers(last(confirmed_only=True)) == full.center).all()
    square = pb.Polygon(x=[0, 10, 10, 0], y=[15, 15, 25, 25])
    assert (centers(last(area=square)) == full.center[[row]]).all()
    few = last(fields=["center", "existence"])
    assert {field.name for field, _ in few.ListFields() if field.message_type is pb.Array.DESCRIPTOR} == {
        "id", "center", "existence",
    }  # fmt: skip
    assert last(min_existence=1.0).id.shape[0] == int((full.existence >= 1.0).sum())


def test_predicted_paths_are_asked_for_and_chosen(stub: Any, stream: str) -> None:
    """`SetParameters` with horizons gives tracks with paths; rows and columns of these are chosen as of all others."""
    horizons = np.array([0.5, 1.0, 3.0])
    wanted = pb.SessionParameters(horizons=pb.Array(dtype=pb.DATA_TYPE_F8, shape=[3], data=horizons.tobytes()))
    in_force = stub.SetParameters(pb.SetParametersRequest(stream=stream, parameters=wanted)).parameters
    assert convert.column(in_force.horizons).tolist() == horizons.tolist()
    full = convert.from_proto(tracked(stub, stream)[-1], Tracks)
    assert full.path_yaw is not None
    assert full.path_yaw.shape == (2, 3)
    chosen = pb.TrackFilter(classes=["pedestrian"], fields=["path_yaw"])
    last = [one.tracks for one in stub.QueryTracks(pb.QueryTracksRequest(pattern=stream, filter=chosen))][-1]
    (row,) = np.flatnonzero(full.label == full.labels.index("pedestrian"))
    assert convert.column(last.path_yaw).tolist() == full.path_yaw[[row]].tolist()
    assert convert.column(last.horizons).tolist() == horizons.tolist()
    assert not last.HasField("path_position")


def test_an_unlikely_object_is_not_confirmed(stub: Any, stream: str) -> None:
    """A track that the tracker does not confirm is left out of confirmed ones, as long as it does not."""
    # The generic profile confirms at the second detection, the nuScenes profile weighs scores.
    stub.SetParameters(pb.SetParametersRequest(stream=stream, parameters=pb.SessionParameters(profile="nuscenes")))
    call = subscribed(stub, pattern=stream, filter=pb.TrackFilter(confirmed_only=True))
    unlikely = [frame(seq, stream, score=np.array([0.9, 0.25 + 0.1 * seq])) for seq in range(5)]
    likely = [frame(seq, stream) for seq in range(5, 10)]
    published = [one.tracks for one in stub.Track(detections(one) for one in (*unlikely, *likely))]
    full = [convert.from_proto(tracks, Tracks) for tracks in published]
    counts = [one.tracks.id.shape[0] for one in taken(call, 10)]
    assert [len(tracks.id) for tracks in full[2:]] == [2] * 8
    assert counts == [int((tracks.confirmed == 1).sum()) for tracks in full]
    assert (counts[:5], counts[9]) == ([1] * 5, 2)


def test_the_rate_is_bounded_in_sensor_time(stub: Any, stream: str) -> None:
    """At 2 Hz every fifth frame of a sensor of 10 Hz comes, however fast they were sent."""
    call = subscribed(stub, pattern=stream, max_rate_hz=2.0)
    tracked(stub, stream)
    assert [one.tracks.seq for one in taken(call, 6)] == [0, 5, 10, 15, 20, 25]


def test_query_by_time(stub: Any, stream: str) -> None:
    """Frames of a range of stamps, both ends included, in their order; 100 of a stream are kept."""
    tracked(stub, stream, range(130))
    first, last = (frame(seq, stream).stamp_ns for seq in (50, 60))
    ranged = stub.QueryTracks(pb.QueryTracksRequest(pattern=stream, from_ns=first, to_ns=last))
    assert [one.tracks.seq for one in ranged] == list(range(50, 61))
    everything = stub.QueryTracks(pb.QueryTracksRequest(pattern=stream))
    assert [one.tracks.seq for one in everything] == list(range(30, 130))


def test_a_range_that_cannot_be_answered_ends_the_call(stub: Any, stream: str) -> None:
    """One that ends before it begins names the field, as over Zenoh."""
    with pytest.raises(grpc.RpcError) as raised:
        list(stub.QueryTracks(pb.QueryTracksRequest(pattern=stream, from_ns=5, to_ns=4)))
    assert raised.value.code() == grpc.StatusCode.INVALID_ARGUMENT
    assert "to_ns" in raised.value.details()


@pytest.mark.parametrize(
    ("asked", "path"),
    [
        ({"pattern": "garage/**"}, "pattern"),
        ({"filter": pb.TrackFilter(fields=["colour"])}, "filter.fields[0]"),
        ({"filter": pb.TrackFilter(min_existence=2.0)}, "filter.min_existence"),
        ({"filter": pb.TrackFilter(area=pb.Polygon(x=[0, 1], y=[0, 1]))}, "filter.area"),
        ({"filter": pb.TrackFilter(area=pb.Polygon(x=[0, 1, 2], y=[0, float("nan"), 1]))}, "filter.area"),
        ({"max_rate_hz": -1.0}, "max_rate_hz"),
        ({"max_rate_hz": float("nan")}, "max_rate_hz"),
    ],
)
def test_what_cannot_be_asked_for_is_refused(stub: Any, asked: dict[str, Any], path: str) -> None:
    """The status is INVALID_ARGUMENT, its details name the field."""
    with pytest.raises(grpc.RpcError) as raised:
        list(stub.Subscribe(pb.SubscribeRequest(**{"pattern": "garage/*/*", **asked})))
    assert raised.value.code() == grpc.StatusCode.INVALID_ARGUMENT
    status = rpc_status.from_call(raised.value)
    assert status is not None
    assert path.encode() in status.details[0].value


def test_a_queue_above_the_bound_is_refused(stub: Any) -> None:
    """It is RESOURCE_EXHAUSTED."""
    with pytest.raises(grpc.RpcError) as raised:
        list(stub.Subscribe(pb.SubscribeRequest(pattern="a/b/c", queue=100_000)))
    assert raised.value.code() == grpc.StatusCode.RESOURCE_EXHAUSTED


def test_what_is_left_of_a_frame_is_a_message(stub: Any, stream: str) -> None:
    """Filtered by rows alone, tracks are still what the models accept."""
    tracked(stub, stream)
    asked = pb.QueryTracksRequest(pattern=stream, filter=pb.TrackFilter(classes=["car"]))
    for one in stub.QueryTracks(asked):
        assert encode(convert.from_proto(one.tracks, Tracks))


def test_200_subscribers_and_one_asleep(gateway: GatewayProcess, stream: str) -> None:
    """Every reader gets every frame, a sleeping one the number of missed frames, and all take little memory."""
    # A connection of its own for each, whose window does not grow: unread responses wait in the gateway.
    options = [("grpc.use_local_subchannel_pool", 1), ("grpc.http2.bdp_probe", 0), ("grpc.service_config", DEADLINES)]
    many = {"label": np.zeros(100, dtype=int), "center": np.random.default_rng(1).uniform(-90, 90, (100, 3))}
    many |= {"size": np.tile([4.5, 1.9, 1.6], (100, 1)), "yaw": np.zeros(100), "score": np.full(100, 0.9)}
    frames = [frame(seq, stream, **many) for seq in range(FRAMES)]
    before = resident(gateway.process.pid)

    async def subscribe(asleep: asyncio.Event | None) -> tuple[list[int], int]:
        async with grpc.aio.insecure_channel(gateway.address, options=options) as channel:
            asked = pb.SubscribeRequest(pattern=stream, queue=1024 if asleep is None else 8)
            call = rpc.TrackingServiceStub(channel).Subscribe(asked)
            await call.initial_metadata()
            in_force.release()
            if asleep is not None:
                await asyncio.wait_for(asleep.wait(), 60)
            received, skipped = [], 0
            while not received or received[-1] < FRAMES - 1:
                response = await call.read()
                received.append(response.tracks.seq)
                skipped += response.skipped
            return received, skipped

    in_force = asyncio.Semaphore(0)

    async def together() -> None:
        asleep = asyncio.Event()
        readers = [asyncio.create_task(subscribe(None)) for _ in range(SUBSCRIBERS - 1)]
        sleeper = asyncio.create_task(subscribe(asleep))
        for _ in range(SUBSCRIBERS):
            await asyncio.wait_for(in_force.acquire(), 60)
        stub = gateway.stub()
        for one in frames:
            await asyncio.to_thread(lambda one=one: list(stub.Track(iter([detections(one)]))))
        for received, skipped in await asyncio.gather(*readers):
            assert (received, skipped) == (list(range(FRAMES)), 0)
        taken = resident(gateway.process.pid) - before
        asleep.set()
        late, skipped = await sleeper
        assert skipped > 0
        assert len(late) + skipped == FRAMES
        assert taken < SUBSCRIBERS * SUBSCRIBER_BYTES

    asyncio.run(together())
