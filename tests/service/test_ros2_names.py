"""Names, tokens and attachments of rmw_zenoh: the same text and bytes as another program that speaks to it."""

import dataclasses
import re

import pytest
import ros2_client  # noqa: F401 - tells the SDK not to look for git
from optipmb_service.edges.ros2 import graph
from zenoh_ros2_sdk.attachment import Attachment
from zenoh_ros2_sdk.entity import EndpointEntity, EntityKind, NodeEntity
from zenoh_ros2_sdk.keyexpr import endpoint_liveliness_keyexpr, node_liveliness_keyexpr, topic_keyexpr
from zenoh_ros2_sdk.qos import QosDurability, QosProfile, QosReliability
from zenoh_ros2_sdk.utils import ros2_to_dds_type

TYPE = "vision_msgs/msg/Detection3DArray"
HASH = f"RIHS01_{'4f' * 32}"
TOPIC = "/front/lidar/boxes"
BEST_EFFORT = graph.Qos(reliable=False, depth=5)
LASTING = graph.Qos(transient_local=True, depth=100)


def endpoint(kind: str = graph.PUBLISHER, qos: graph.Qos = graph.Qos(), name: str = "detector") -> graph.Endpoint:  # noqa: B008 - frozen
    return graph.Endpoint(graph.Node(7, "a1b2c3", name, "/robot/front", 4), 9, kind, TOPIC, TYPE, HASH, qos)


@pytest.mark.parametrize("kind", [graph.PUBLISHER, graph.SUBSCRIPTION])
@pytest.mark.parametrize("qos", [graph.Qos(), BEST_EFFORT, LASTING])
def test_tokens_and_keys_are_those_of_another_program(kind: str, qos: graph.Qos) -> None:
    """A node, its endpoints and a topic's key read the same, and a token that was written is read as it was."""
    ours = endpoint(kind, qos)
    node = NodeEntity(7, "a1b2c3", 4, "detector", "/robot/front")
    profile = QosProfile(
        reliability=QosReliability.RELIABLE if qos.reliable else QosReliability.BEST_EFFORT,
        durability=QosDurability.TRANSIENT_LOCAL if qos.transient_local else QosDurability.VOLATILE,
        history_depth=qos.depth,
    )
    dds = ros2_to_dds_type(TYPE)
    theirs = EndpointEntity(node, 9, EntityKind(kind), TOPIC, dds, HASH, profile.encode())
    assert ours.token() == endpoint_liveliness_keyexpr(theirs)
    assert ours.node.token() == node_liveliness_keyexpr(node)
    assert graph.TopicKey(7, TOPIC, TYPE, HASH).key == topic_keyexpr(7, TOPIC, dds, HASH)
    assert graph.parse_endpoint(ours.token()) == graph.parse_endpoint(f"{ours.token()}/more") == ours
    assert graph.parse_topic(graph.TopicKey(7, TOPIC, TYPE, HASH).key) == (7, TOPIC, TYPE, HASH)


def test_an_attachment_is_read_by_another_program() -> None:
    """Number, time and publisher of a message."""
    gid = bytes(range(graph.GID))
    assert Attachment.from_bytes(graph.attachment(3, 10**18, gid)) == Attachment(3, 10**18, gid)
    assert Attachment(3, 10**18, gid).to_bytes() == graph.attachment(3, 10**18, gid)


@pytest.mark.parametrize(
    ("other", "text"),
    [
        (endpoint(), ""),
        (endpoint(graph.SUBSCRIPTION), ""),
        (endpoint(qos=LASTING), ""),
        (dataclasses.replace(endpoint(), hash=graph.NO_HASH), ""),
        (dataclasses.replace(endpoint(), topic="/other"), ""),
        (endpoint(qos=BEST_EFFORT), "with a quality of service .* asked for RELIABLE, offered BEST_EFFORT"),
        (dataclasses.replace(endpoint(), hash="RIHS01_0"), f"another definition of {TYPE} .RIHS01_0, expected {HASH}"),
        (dataclasses.replace(endpoint(), type="a/msg/B"), f"a/msg/B, expected {TYPE}"),
    ],
)
def test_what_does_not_match_is_named_once(other: graph.Endpoint, text: str) -> None:
    """Another type, another definition and a weaker offer are problems from when a node comes until it goes."""
    matching = graph.Matching((endpoint(graph.SUBSCRIPTION, name="bridge"),), frozenset())
    new = matching.change(other, came=True)
    assert len(new) == bool(text)
    for problem in new:
        assert re.match(f"{TOPIC}: node /robot/front/detector (publishes )?{text}", problem)
    assert matching.change(other, came=True) == ()
    assert matching.problems() == new
    matching.change(other, came=False)
    assert matching.problems() == ()


def test_two_publishers_of_detections_are_a_problem() -> None:
    """The second one is reported, and no longer when it has gone."""
    matching = graph.Matching((endpoint(graph.SUBSCRIPTION, name="bridge"),), frozenset({TOPIC}))
    assert matching.change(endpoint(), came=True) == ()
    assert "2 publishers" in matching.change(endpoint(name="other"), came=True)[0]
    matching.change(endpoint(), came=False)
    assert matching.problems() == ()
