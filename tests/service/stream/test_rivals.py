"""Streams that several instances track."""

from optipmb_service.streams.rivals import Rivals


def test_a_stream_with_two_owners_is_contested_after_a_while() -> None:
    """One that takes over is not, nor one whose second owner has gone; the others are asked for again first."""
    rivals = Rivals("m0", patience_ns=100)
    rivals.on_owner("s/n/b", "m1", True)
    rivals.on_owner("s/n/a", "m1", True)
    assert not list(rivals.contested(0, ["s/n/a"]))
    assert not list(rivals.contested(100, ["s/n/a"]))
    assert not rivals.doubted
    assert not list(rivals.contested(101, ["s/n/a"]))
    assert rivals.doubted == {"s/n/a"}
    again = Rivals("m0", 100, rivals.doubted)
    again.on_owner("s/n/a", "m1", True)
    assert not list(again.contested(0, ["s/n/a"]))
    assert list(again.contested(101, ["s/n/a"])) == [("s/n/a", ["m0", "m1"])]
    assert not list(again.contested(300, []))
    assert not list(again.contested(400, ["s/n/a"]))


def test_two_others_may_contest_a_stream() -> None:
    """Who looks need not be one of them; a token of its own tells nothing."""
    rivals = Rivals("m0", 100, {"s/n/a"})
    for instance in ("m0", "m1", "m2"):
        rivals.on_owner("s/n/a", instance, True)
    assert not list(rivals.contested(0, []))
    assert list(rivals.contested(101, [])) == [("s/n/a", ["m1", "m2"])]
    rivals.on_owner("s/n/a", "m1", False)
    assert not list(rivals.contested(300, []))
    assert rivals.tracks("s/n/a")
    rivals.on_owner("s/n/a", "m2", False)
    assert not rivals.tracks("s/n/a")
