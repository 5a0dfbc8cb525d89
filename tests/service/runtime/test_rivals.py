"""Streams that several instances track."""

from optipmb_service.runtime.rivals import Rivals


def test_a_stream_with_two_owners_is_contested_after_a_while() -> None:
    """One that takes over from another is not, nor is a stream whose second owner has gone."""
    rivals = Rivals(patience_ns=100)
    rivals.on_owner("s/n/a", "m0", True)
    rivals.on_owner("s/n/b", "m0", True)
    rivals.on_owner("s/n/a", "m1", True)
    assert not list(rivals.contested(0))
    assert not list(rivals.contested(100))
    assert list(rivals.contested(101)) == [("s/n/a", ["m0", "m1"])]
    rivals.on_owner("s/n/a", "m0", False)
    assert not list(rivals.contested(300))
    rivals.on_owner("s/n/a", "m0", True)
    assert not list(rivals.contested(400))
    assert rivals.tracks("s/n/a")
    for instance in ("m0", "m1"):
        rivals.on_owner("s/n/a", instance, False)
    assert not rivals.tracks("s/n/a")
    assert rivals.tracks("s/n/b")
