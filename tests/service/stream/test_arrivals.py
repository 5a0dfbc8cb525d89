"""What a session knows of its sources: whose caches are asked, who has answered, and for how long frames wait."""

from optipmb_service.session.arrivals import BACK_NS, MOST, Arrivals
from optipmb_service.session.policy import Policy

POLICY = Policy(recovery_wait_ns=4 * BACK_NS)


def test_each_cache_is_asked_once_until_it_fails_to_answer_in_full() -> None:
    """Only present publishers are asked, none twice, and one again whose answer was cut."""
    one = Arrivals(POLICY, {})
    caches = {"site/node/a": True, "site/node/b": True, "site/node/gone": False}
    assert one.to_ask(caches) == ["site/node/a", "site/node/b"]
    assert one.to_ask(caches) == []
    one.ask_again("site/node/b")
    assert one.to_ask(caches) == ["site/node/b"]


def test_arrivals_are_complete_when_every_cache_has_answered() -> None:
    """A publisher that may come back counts as much as a present one."""
    one = Arrivals(POLICY, {})
    one.resume(now_ns=0, young_ns=None)
    caches = {"site/node/a": True, "site/node/gone": False}
    one.answer("site/node/a")
    assert not one.complete(caches, now_ns=1)
    one.answer("site/node/gone")
    assert one.complete(caches, now_ns=1)


def test_a_young_session_gives_tokens_of_unknown_sensors_time_to_come() -> None:
    """A session that began, or was restored from its beginning, is not complete while its sensors may be unknown."""
    begun, restored = Arrivals(POLICY, {}), Arrivals(POLICY, {})
    begun.begin(stamp_ns=7, arrived_ns=0, now_ns=0)
    restored.resume(now_ns=0, young_ns=7)
    for one in (begun, restored):
        assert not one.complete({}, now_ns=BACK_NS - 1)
        assert one.complete({}, now_ns=BACK_NS)


def test_publishers_that_come_and_go_leave_nothing_behind() -> None:
    """However many caches have answered, a bounded number is remembered, and a forgotten one is asked again."""
    one = Arrivals(POLICY, {})
    for number in range(10 * MOST):
        stream = f"site/node/{number}"
        assert one.to_ask({stream: True}) == [stream]
        one.answer(stream)
    assert len(one.answered) == MOST
    assert one.to_ask({"site/node/0": True, f"site/node/{10 * MOST - 1}": True}) == ["site/node/0"]
