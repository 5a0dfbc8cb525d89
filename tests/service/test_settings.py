"""Settings that cannot be used."""

import re
from typing import Any

import pytest
from optipmb_service.app.configuration import SettingsInvalidError, load

INPUTS: dict[str, dict[str, Any]] = {
    "a/b": {"a/b": {"topic": "x"}},
    "a/b/c.topic": {"a/b/c": {"topic": "x/+"}},
    "a/{1}/c.topic": {"a/{1}/c": {"topic": "x"}},
    "a/b/c": {"a/{1}/c": {"topic": "x/+"}, "a/b/c": {"topic": "y"}},
    "a/b/d.topic": {"a/{1}/c": {"topic": "x/+"}, "a/b/d": {"topic": "x/y"}},
    "a/b/e.topic": {"a/b/c": {"topic": "x"}, "a/b/e": {"topic": "x"}},
    "a/b/f.topic": {"a/b/f": {"topic": "optipmb/v1/a/b/f/tracks"}},
}
"""Inputs over MQTT, by the setting that is named."""
FORMATS: dict[str, dict[str, Any]] = {
    "a/b/c.only": {"a/b/c": {"format": "frigate"}},
    "a/b/c.format": {"a/b/c": {"format": "yaml"}},
    "a/b/c.mapping": {"a/b/c": {"format": "mapped"}},
    "a/b/c.mapping.objects": {"a/b/c": {"format": "mapped", "mapping": {"objects": "a b", "class": "c"}}},
}
"""The same of `inputs`."""
JOINS = {
    "gap_s": 0,
    "min_probability": 1.0,
    "most": 0,
    "decide_s": 6,
    "other": 1,
    "embedding_model": "",
    "exits": [[[0, 0]]],
}
PATTERN = "a pattern of streams looks like site/*/lidar*"
ONE_SITE = "patterns of one site, named without *, received"
NODES = {"a": {"streams": ["s/n/*"]}}


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (
            {"gap_limit_s": "x"},
            "unable to parse string as a number; received 'x'",
        ),
        ({"gap_limit_s": -1}, "gap_limit_s (from the option): input should be greater than 0; received -1"),
        ({"outputs": {"a/b": {}}}, f"outputs.a/b.[key] (from the option): {PATTERN}"),
        ({"outputs": {"*/*/*": {"rate_hz": 51}}}, "outputs.*/*/*.rate_hz"),
        ({"outputs": {"*/*/*": {"clock": "gps"}}}, "outputs.*/*/*.clock"),
        ({"outputs": {"*/*/*": {"delay_s": -1}}}, "outputs.*/*/*.delay_s"),
        ({"outputs": {"*/*/*": {"rate": 5}}}, "outputs.*/*/*.rate (from the option): unknown setting"),
        ({"sensors": {"site/rear": {}}}, PATTERN),
        ({"sensors": {"site/*/rear": {"trusts_size": False}}}, "sensors.site/*/rear.trusts_size"),
        ({"sensors": {"site/*/rear": {"trust_size": "perhaps"}}}, "sensors.site/*/rear.trust_size"),
        ({"fuse": ["site/node"]}, f"{PATTERN}, received 'site/node'"),
        ({"fuse": ["site/node/*"], "rewind_s": 0}, "rewind_s must not be 0"),
        ({"fused": NODES, "rewind_s": 0}, "rewind_s must not be 0"),
        ({"fused": {"a": {"streams": ["*/n/*"]}}}, f"{ONE_SITE} *"),
        ({"fused": {"a": {"streams": ["s/n/*", "t/n/*"]}}}, f"{ONE_SITE} s, t"),
        ({"fused": {"a": {"streams": []}}}, "fused.a.streams"),
        ({"fused": {"a": {"streams": ["s/n/*"] * 65}}}, "fused.a.streams"),
        ({"fused": {"a/b": {"streams": ["s/n/*"]}}}, "fused.a/b"),
        ({"fused": {"a": {"streams": ["s/fused/x"]}}}, "no node is named fused"),
        ({"fused": {"a": {"streams": ["s/n/*"], "read": ["kiosk"]}}}, "a node looks like site/node, received 'kiosk'"),
        ({"fused": NODES, "fuse": ["*/*/lidar"]}, "and */*/lidar of fuse have some in common"),
        (
            {"fused": {"a": {"streams": ["s/n/x*"]}, "b": {"streams": ["s/*/*y"]}}},
            "fused.b.streams: a stream feeds one session, s/*/*y and s/n/x* of fused.a.streams have some in common",
        ),
        *(({"rejoin": {"site/*/*": {name: value}}}, f"rejoin.site/*/*.{name}") for name, value in JOINS.items()),
        *(
            ({"mqtt": {"inputs": inputs}, "inputs": {"a/b/c": {"only": {"n": 1}}}}, f"mqtt.inputs.{name}")
            for name, inputs in INPUTS.items()
        ),
        *(({"inputs": inputs}, f"inputs.{name}") for name, inputs in FORMATS.items()),
    ],
)
def test_a_wrong_setting_is_named(options: dict[str, Any], text: str) -> None:
    """By its path, with its source, the expected and the received value."""
    with pytest.raises(SettingsInvalidError, match=rf"^setting .*{re.escape(text)}"):
        load(None, options)
