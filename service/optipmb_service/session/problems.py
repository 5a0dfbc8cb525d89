"""The problems that a service reports: their codes, and how a problem is made so that its texts fit the message."""

from __future__ import annotations

from typing import Any, Final

import optipmb_schemas as schemas

from optipmb_service.units import DAY_S

CODES: Final = {
    "malformed": ("The bytes are not a message.", "Check the publisher's encoder; compare with the JSON Schemas."),
    "wrong_type": ("The message type does not belong on this key.", "Check the key and the encoding of the publisher."),
    "unsupported_version": ("The service does not support this major version.", "Update the service or the publisher."),
    "too_large": ("A size, count or nesting above the limit.", "Send less, or raise `limits`."),
    "missing_field": ("A required field is absent.", "Send the field that `path` names."),
    "invalid_value": ("A field has a wrong value; the whole frame is refused.", "Look at `path`: NaN, sizes, scores?"),
    "unknown_class": (
        "Objects of a class that the profile lacks are left out.",
        "Choose another profile, or send the names of its classes.",
    ),
    "score_filter": (
        "Most scores of a class are below the profile's `score_filter`.",
        "Choose the profile `generic`, or lower the filter of the class.",
    ),
    "velocity": (
        "Most velocities contradict the motion of their boxes.",
        "Send velocities over ground, in m/s, along the axes of the boxes; or none.",
    ),
    "size": (
        "Most boxes are wider than long, or far from the sizes of their classes.",
        "Send length, width, height in metres.",
    ),
    "no_pose": (
        "The sensor moves, and its frames have no pose: the motion is estimated.",
        "Send poses: without them tracks are in the axes of the sensor.",
    ),
    "embedding": (
        "Vectors are of another model than `embedding_model` of `rejoin`.",
        "Send vectors of that model, or set the one that is sent.",
    ),
    "far": (
        "Tracks are far from the origin of their site in `sites`: latitudes are wrong.",
        "Send metres from that origin, not UTM; or correct `origin`.",
    ),
    "no_view": (
        "A sensor of a fused session with `sensors` has no `field_of_view`.",
        "Send one: without it objects that only other sensors see count as missed.",
    ),
    "late": (
        "The frame came later than the window in which tracks are corrected.",
        "Publish in order, or raise `rewind_s`.",
    ),
    "duplicate_epoch": (
        "A publisher that was replaced by another one still sends.",
        "Stop one of the two: the tracks have the `epoch` of the other one.",
    ),
    "duplicate_seq": (
        "A frame has the epoch and the number of another one; it is refused.",
        "Give the publisher a new random epoch at every start.",
    ),
    "duplicate_key": (
        "A JSON frame has the key or the stamp of another one; it is refused.",
        'Send finer stamps, or `epoch` and `seq`; or set `clock = "arrival"` in `inputs`.',
    ),
    "links": (
        "`optipmb-service link` leaves out what `path` names, or two streams differ by much.",
        "Look at `received`: a wrong clock, a frame of another site, too many streams or tracks.",
    ),
    "shed": ("The queue was full and the oldest frames were dropped.", "Lower the rate, or add processors."),
    "refused": (
        "No room for another session, or a change that needs a restart.",
        "Raise `max_sessions` or quotas; see `path`.",
    ),
    "quota": (
        "The node, or its site, sends more than its quota.",
        "Send less, or raise `node_rate`, `node_mb_s`, `site_rate`, `site_mb_s`.",
    ),
    "astray": (
        "The sensor cannot have reached this pose since its last frame; the frame is refused.",
        "Check the localisation; if it is right, raise `max_speed`.",
    ),
    "world_jump": (
        "The pose is not where the sensor was moving; tracks may end.",
        "Announce motions of the world as `relocation`. Otherwise check the localisation.",
    ),
    "time_jump": (
        "The stamp is over `gap_limit_s` ahead or `rewind_s` behind; refused until three frames agree.",
        "Check the sensor's clock.",
    ),
    "clock": (
        "Stamps do not advance, or not in nanoseconds, or, with `outputs`, are not system time.",
        "Send the time of the measurement in nanoseconds; in `outputs`, see `clock`.",
    ),
    "restarted": (
        "The session restarted, and its tracks ended; `received` has the reason.",
        "After `jump`, `clock` or `pose`: check clock and localisation.",
    ),
    "overload": (
        "The frame, or the stream, takes too much computing time; it is refused.",
        "Suppress overlapping boxes in the detector, send less, or raise `max_pairs`, `step_limit_s`.",
    ),
    "superseded": (
        "The instance was frozen or cut off; another one tracks the stream now.",
        "If it happens often, raise `lease_s`, or look for what stops the process.",
    ),
    "certificate": (
        "A certificate of the service has ended, or does not fit its key; `received` names it.",
        "Renew it; see `security.md`. A process that listens with it needs a restart.",
    ),
    "contested": (
        "Two instances without the same `store` track the stream.",
        "Give them one `store` or `cluster`, or routers of their own.",
    ),
    "duplicate_name": (
        "Another process answers by the name of this instance.",
        "Give each its own `instance`, or none: the default is unique.",
    ),
    "numbers_back": (
        "A publisher began again with the Zenoh id of its last run: Zenoh drops its messages.",
        "Remove `id` from its Zenoh configuration, and start it again.",
    ),
    "cut": (
        "In answers to `q/tracks`: there are more tracks than one answer takes.",
        "Ask again from `stamp_ns` on, as `optipmb_client.kept_tracks` does.",
    ),
    "message_log": (
        "A message is not in the message log: NATS was away for too long, or does not take it.",
        "See the NATS servers; the tracks are not affected.",
    ),
    "internal": (
        "A bug in the service. After a failed step the last frames are saved.",
        "Report it, with the saved file, which `optipmb track --dump` replays.",
    ),
    "quarantined": (
        "Tracking this stream failed, see `internal`; its frames are refused.",
        "Reset the session, or restart the publisher.",
    ),
}
"""Meaning and remedy of every code of a problem."""

SENTENCES: Final = {
    "late": "{subject}: it came too late, {apart} the newest one.",
    "time_jump": "{subject}: its stamp is {apart} the newest one; expected {expected}.",
    "jump": "{subject}: tracks begin anew, because stamps jumped; it is {apart} the newest one.",
    "clock": "{subject}: stamps went back, it is {apart} the newest one; objects that are found again keep their ids.",
    "publisher": "{subject}: tracks begin anew with a new publisher; it is {apart} the newest one.",
    "pose": "{subject}: tracks begin anew, because its pose is out of reach of the last one.",
    "world": "{subject}: tracks begin anew, because its world frame is another one.",
    "effort": "{subject}: tracks begin anew, because they took too much computing time.",
}
"""Message of a frame's problem by its code, of `restarted` by the reason; `apart`: from the newest frame in time."""

MAX_TEXT: Final = 500
"""Characters of a text in a problem."""


def problem_of(code: str, *, subject: str = "", **fields: Any) -> schemas.Problem:
    """Return a problem, its texts printable and cut to what the message allows.

    Args:
        code: one of `CODES`.
        subject: begins the message, unless that is among the fields.
        fields: further fields of the message.
    """
    fields = {"path": "", "expected": "", "received": ""} | fields
    place = f"{subject}: {fields['path']}" if fields["path"] else subject
    fields.setdefault("message", f"{place}: expected {fields['expected']}, received {fields['received']}.")
    texts = {name: _fit(fields[name]) for name in ("path", "expected", "received", "message")}
    return schemas.Problem(code=code, **fields | texts)


def _fit(text: str) -> str:
    text = "".join(character if character.isprintable() else "?" for character in text[: MAX_TEXT + 1])
    return text if len(text) <= MAX_TEXT else text[: MAX_TEXT - 3] + "..."


def sentence(kind: str, subject: str, jump_ns: int, expected: str = "") -> str:
    """Return the message of a problem of `SENTENCES`, of a frame that is so far from the newest one."""
    seconds = abs(jump_ns) / 1e9
    long = f"{seconds / DAY_S:.0f} days" if seconds >= 2 * DAY_S else f"{seconds:.2f} s"
    return SENTENCES[kind].format(
        subject=subject, apart=f"{long} {'before' if jump_ns < 0 else 'after'}", expected=expected
    )
