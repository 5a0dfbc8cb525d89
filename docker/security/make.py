#!/usr/bin/env python3
"""Makes what a protected network needs: certificates of an own authority, and Zenoh configurations that use them.

python3 docker/security/make.py --out tls --router router.local --router 10.0.0.1 --service tracker \
    --node garage/robot-1 --node garage/robot-2 --viewer ops

A folder for each machine, to be copied there as it is: its key, its certificate, the authority's certificate and a
`zenoh.json5`. The router's has the access control: who may do what follows from the name (CN) in the certificate.
Run again, it keeps the authority and every certificate that still holds, and adds what is new; `--renew` makes all
certificates but the authority's again. Needs Python and the `openssl` command, nothing else.

The authority made here is for trials and small fleets: its key lies in `authority/ca.key`, unencrypted. A company's
own authority can take its place as long as the names in the certificates are the same.
"""

from __future__ import annotations

import argparse
import ipaddress
import json
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

CHUNK: Final = re.compile(r"[A-Za-z0-9_.-]+")
MAX_NAME: Final = 64  # characters of a CN
SOON_S: Final = 7 * 24 * 3600  # a certificate that ends within a week is renewed
PORT: Final = 7447
NODE_CHUNKS: Final = 2

READ: Final = ("declare_subscriber", "liveliness_query", "declare_liveliness_subscriber")
WRITE: Final = ("put", "delete")
TOKEN: Final = ("liveliness_token",)
ASK: Final = ("query",)
ANSWER: Final = ("declare_queryable", "reply")


class MakeError(Exception):
    """It cannot be made; the text is one clear line."""


@dataclass(frozen=True)
class Role:
    """A party at the router: the name in its certificate, its folder, and the messages it may send and receive."""

    name: str
    folder: str
    sends: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...]
    receives: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...]


OUTPUTS = ("tracks", "now", "events", "problems")


def recoverable(*keys: str) -> tuple[str, ...]:
    """Give keys with those below them that recovery uses: caches, heartbeats, tokens of publishers."""
    return tuple(key for one in keys for key in (one, f"{one}/@adv/**"))


def node(prefix: str, name: str, reads: tuple[str, ...] = ()) -> Role:
    """Give a perception node `site/node`: it publishes for its own sensors, and reads their results, and `reads`."""
    inputs = recoverable(f"{prefix}/{name}/*/detections", f"{prefix}/{name}/*/points")
    outputs = recoverable(*(f"{prefix}/{one}/{topic}" for one in (f"{name}/*", *reads) for topic in OUTPUTS))
    questions = (f"{prefix}/{name}/*/q/*",)
    presence = (f"{prefix}/service/*/alive", *(f"{prefix}/owner/{one}/*" for one in (f"{name}/*", *reads)))
    everywhere = recoverable(f"{prefix}/**")
    return Role(
        name,
        f"node/{name}",
        sends=(
            (WRITE + TOKEN + ANSWER, inputs),
            (READ, outputs + presence),
            (ASK, outputs + questions),
        ),
        # What others declare is wider than one node (`*/*/*/detections`), and a grant must include all of it.
        receives=(
            (READ + ASK + ANSWER, everywhere),
            (WRITE + TOKEN, outputs),
            (TOKEN, presence),
        ),
    )


def service(prefix: str, name: str) -> Role:
    """Give a tracking service: it reads all inputs, writes all outputs, answers, and owns streams."""
    inputs = recoverable(f"{prefix}/*/*/*/detections", f"{prefix}/*/*/*/points")
    outputs = recoverable(*(f"{prefix}/*/*/*/{topic}" for topic in OUTPUTS))
    outputs += recoverable(f"{prefix}/links/*")
    questions = (f"{prefix}/*/*/*/q/*", f"{prefix}/service/*/q/*", f"{prefix}/links/*/q/links")
    presence = (f"{prefix}/service/**", f"{prefix}/owner/**")
    return Role(
        f"service/{name}",
        f"service/{name}",
        sends=(
            (READ + ASK, inputs + outputs),
            (WRITE + TOKEN + ANSWER, outputs),
            (ANSWER + ASK, questions),
            (READ + TOKEN, presence),
        ),
        receives=(
            (READ + ASK + ANSWER, recoverable(f"{prefix}/**")),
            (WRITE + TOKEN, inputs + outputs),
            (TOKEN, presence),
        ),
    )


def viewer(prefix: str, name: str) -> Role:
    """Give a person or program that looks: it reads everything, asks about it, and writes nothing."""
    everything = recoverable(*(f"{prefix}/*/*/*/{topic}" for topic in ("detections", "points", *OUTPUTS)))
    everything += recoverable(f"{prefix}/links/*")
    questions = tuple(f"{prefix}/*/*/*/q/{what}" for what in ("state", "density", "tracks"))
    questions += (f"{prefix}/service/*/q/status", f"{prefix}/service/*/q/metrics", f"{prefix}/links/*/q/links")
    presence = (f"{prefix}/service/**", f"{prefix}/owner/**")
    return Role(
        f"viewer/{name}",
        f"viewer/{name}",
        sends=((READ + ASK, everything), (ASK, questions), (READ, presence)),
        receives=((WRITE + TOKEN, everything), (TOKEN, presence), (ANSWER, recoverable(f"{prefix}/**"))),
    )


def gateway(prefix: str, name: str) -> Role:
    """Give a gRPC gateway: it acts with its callers' rights, and checks their certificates itself."""
    inputs = recoverable(f"{prefix}/*/*/*/detections", f"{prefix}/*/*/*/points")
    outputs = recoverable(*(f"{prefix}/*/*/*/{topic}" for topic in OUTPUTS))
    questions = (f"{prefix}/*/*/*/q/*", f"{prefix}/service/*/q/status", f"{prefix}/links/*/q/links")
    presence = (f"{prefix}/service/*/alive",)
    return Role(
        f"gateway/{name}",
        f"gateway/{name}",
        sends=(
            (WRITE + TOKEN + ANSWER, inputs),
            (WRITE, (f"{prefix}/*/*/*/problems",)),
            (READ + ASK, outputs),
            (ASK, questions),
            (READ, presence),
        ),
        receives=(
            (READ + ASK + ANSWER, recoverable(f"{prefix}/**")),
            (WRITE + TOKEN, outputs),
            (TOKEN, presence),
        ),
    )


def access_control(roles: list[Role]) -> dict[str, Any]:
    """Give the router's table of permissions; unlisted parties may do nothing."""
    rules, subjects, policies = [], [], []
    for role in roles:
        names = []
        for flow, grants in (("ingress", role.sends), ("egress", role.receives)):
            for number, (messages, keys) in enumerate(grants):
                names.append(f"{role.name} {flow} {number}")
                rules.append(
                    {
                        "id": names[-1],
                        "permission": "allow",
                        "flows": [flow],
                        "messages": list(dict.fromkeys(messages)),
                        "key_exprs": list(keys),
                    }
                )
        subjects.append({"id": role.name, "cert_common_names": [role.name]})
        policies.append({"rules": names, "subjects": [role.name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def limits(prefix: str, megabytes: float, rate: float) -> dict[str, Any]:
    """Give the router's limits on what one link sends: bytes of a message, and messages a second of each topic.

    The router has no memory of quiet times: it drops messages closer than 1 / rate after the message before, from
    whichever sensor of the link. So the rate must be far above the sum of the sensors' rates.
    """
    inputs = {topic: f"{prefix}/*/*/*/{topic}" for topic in ("detections", "points")}
    return {
        "low_pass_filter": [
            {
                "id": "size",
                "flows": ["ingress"],
                "messages": ["put", "delete", "query", "reply"],
                "key_exprs": ["**"],
                "size_limit": round(megabytes * 1e6),
            }
        ],
        "downsampling": [
            {
                "id": topic,
                "flows": ["ingress"],
                "messages": ["put"],
                "rules": [{"key_expr": key, "freq": rate}],
            }
            for topic, key in inputs.items()
        ],
    }


class Authority:
    """Issues certificates by the `openssl` command.

    Args:
        folder: of its key and certificate; made when they are not there.
        days: how long certificates hold.
    """

    def __init__(self, folder: Path, days: int) -> None:
        self._folder = folder
        self._days = days
        self.certificate = folder / "ca.pem"
        if not self.certificate.exists():
            folder.mkdir(parents=True, exist_ok=True)
            folder.chmod(0o700)
            _key(folder / "ca.key")
            _openssl(
                "req", "-x509", "-new", "-key", folder / "ca.key", "-out", self.certificate, "-days", "3650",
                config="[req]\nprompt = no\ndistinguished_name = name\nx509_extensions = ca\n[name]\n"
                "CN = optipmb authority\n[ca]\nbasicConstraints = critical, CA:true, pathlen:0\n"
                "keyUsage = critical, keyCertSign, cRLSign\nsubjectKeyIdentifier = hash\n",
            )  # fmt: skip

    def issue(self, folder: Path, name: str, hosts: tuple[str, ...], *, renew: bool) -> bool:
        """Put a key, a certificate and the authority's certificate into a folder.

        Args:
            folder: where to.
            name: the CN.
            hosts: names and addresses under which it is a server; without any it is a client alone.
            renew: also when the present one still holds.

        Returns:
            Whether a new certificate was made.
        """
        folder.mkdir(parents=True, exist_ok=True)
        key, certificate = folder / "key.pem", folder / "cert.pem"
        shutil.copyfile(self.certificate, folder / "ca.pem")
        if not renew and certificate.exists() and _holds(certificate):
            return False
        _key(key)
        usage = "serverAuth, clientAuth" if hosts else "clientAuth"
        # The name also stands among the alternative names: some verifiers want at least one.
        names = ", ".join(_alternative(host) for host in hosts) or f"URI:optipmb:{name}"
        extensions = (
            f"[extensions]\nbasicConstraints = critical, CA:false\nkeyUsage = critical, digitalSignature\n"
            f"extendedKeyUsage = {usage}\nsubjectAltName = {names}\n"
        )
        head = f"[req]\nprompt = no\ndistinguished_name = name\n[name]\nCN = {name}\n"
        request = folder / "request.pem"
        _openssl("req", "-new", "-key", key, "-out", request, config=head)
        _openssl(
            "x509", "-req", "-in", request, "-CA", self.certificate, "-CAkey", self._folder / "ca.key",
            "-CAcreateserial", "-out", certificate, "-days", str(self._days), "-extensions", "extensions",
            extensions=extensions,
        )  # fmt: skip
        request.unlink()
        return True


def zenoh_client(at: str, endpoints: list[str]) -> dict[str, Any]:
    """Give the configuration of a client, with its files in the folder `at`."""
    drop = {"wait_before_drop": 50_000, "max_wait_before_drop_fragments": 500_000}
    return {
        "mode": "client",
        "connect": {"endpoints": endpoints},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "shared_memory": {"enabled": False},
            "link": {
                "protocols": ["tls"],
                "tx": {"queue": {"congestion_control": {"drop": drop}}},
                "tls": {
                    "root_ca_certificate": f"{at}/ca.pem",
                    "connect_private_key": f"{at}/key.pem",
                    "connect_certificate": f"{at}/cert.pem",
                    "enable_mtls": True,
                    "verify_name_on_connect": True,
                    "close_link_on_expiration": True,
                },
            },
        },
    }


def zenoh_router(at: str, bounds: dict[str, Any], access: dict[str, Any]) -> dict[str, Any]:
    """Give the configuration of the router, with its files in the folder `at`."""
    return {
        "mode": "router",
        "listen": {"endpoints": [f"tls/[::]:{PORT}"]},
        "adminspace": {"enabled": False},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "shared_memory": {"enabled": False},
            "link": {
                "protocols": ["tls"],
                "tls": {
                    "root_ca_certificate": f"{at}/ca.pem",
                    "listen_private_key": f"{at}/key.pem",
                    "listen_certificate": f"{at}/cert.pem",
                    "connect_private_key": f"{at}/key.pem",
                    "connect_certificate": f"{at}/cert.pem",
                    "enable_mtls": True,
                    "close_link_on_expiration": True,
                },
            },
        },
        **bounds,
        "access_control": access,
    }


def make(options: argparse.Namespace) -> list[str]:
    """Make everything; gives one line for each folder.

    Raises:
        MakeError: a name cannot be used, or openssl failed.
    """
    out: Path = options.out
    prefix: str = options.prefix
    reads: dict[str, tuple[str, ...]] = {}
    for one in options.reads:
        name, _, session = one.partition("=")
        reads[_named(name, chunks=2)] = (*reads.get(name, ()), _named(session, chunks=3))
    roles = [
        *(node(prefix, _named(name, chunks=2), reads.pop(name, ())) for name in options.node),
        *(service(prefix, _named(name)) for name in options.service),
        *(viewer(prefix, _named(name)) for name in options.viewer),
    ]
    if reads:
        raise MakeError(f"--reads: expected a node that --node names, received {', '.join(reads)}")
    gateways = [gateway(prefix, _named(host)) for host in options.gateway]
    endpoints = [options.connect or f"tls/{options.router[0]}:{PORT}"]
    authority = Authority(out / "authority", options.days)
    told = []

    def machine(name: str, place: str, hosts: tuple[str, ...], values: dict[str, Any]) -> None:
        fresh = authority.issue(out / place, name, hosts, renew=options.renew)
        text = json.dumps(values, indent=2) + "\n"
        (out / place / "zenoh.json5").write_text(text, encoding="utf-8")
        told.append(f"{out / place}: {'new certificate' if fresh else 'certificate kept'} for {name}")

    def at(place: str) -> str:
        return options.at or str((out / place).absolute())

    bounds = limits(prefix, options.megabytes, options.rate)
    router = zenoh_router(at("router"), bounds, access_control(roles + gateways))
    machine(f"router/{options.router[0]}", "router", tuple(options.router), router)
    for role in roles:
        machine(role.name, role.folder, (), zenoh_client(at(role.folder), endpoints))
    for role, host in zip(gateways, options.gateway, strict=True):
        machine(role.name, role.folder, (host,), zenoh_client(at(role.folder), endpoints))
        names = json.dumps([one.name for one in roles], indent=2) + "\n"
        (out / role.folder / "names.json").write_text(names, encoding="utf-8")
    return told


def _named(name: str, chunks: int = 1) -> str:
    parts = name.split("/")
    good = len(parts) == chunks and all(CHUNK.fullmatch(part) and part not in {".", ".."} for part in parts)
    if (
        not good
        or parts[0] in {"service", "owner", "viewer", "router", "gateway"}
        or (chunks == NODE_CHUNKS and parts[1] == "fused")  # sessions of the nodes of a site have that name
        or len(name) > MAX_NAME - len("service/")
    ):
        shape = ("a name", "site/node", "site/fused/name")[chunks - 1]
        raise MakeError(f"expected {shape} of letters, digits and _ . -, received {name!r}")
    return name


def _alternative(host: str) -> str:
    try:
        return f"IP:{ipaddress.ip_address(host)}"
    except ValueError:
        if not CHUNK.fullmatch(host):
            raise MakeError(f"--router: expected a host or an address, received {host!r}") from None
        return f"DNS:{host}"


def _holds(certificate: Path) -> bool:
    """Tell whether a certificate holds for another week."""
    command = ["openssl", "x509", "-in", str(certificate), "-noout", "-checkend", str(SOON_S)]
    return subprocess.run(command, check=False, capture_output=True).returncode == 0  # noqa: S603 - a fixed command


def _key(file: Path) -> None:
    """Make a key that its owner alone can read, from its first moment on."""
    file.unlink(missing_ok=True)
    file.touch(mode=0o600)
    _openssl("ecparam", "-name", "prime256v1", "-genkey", "-noout", "-out", file)


def _openssl(*arguments: str | Path, config: str = "", extensions: str = "") -> None:
    with tempfile.TemporaryDirectory() as folder:
        options: list[str] = []
        for option, text in (("-config", config), ("-extfile", extensions)):
            if text:
                file = Path(folder) / option.strip("-")
                file.write_text(text, encoding="utf-8")
                options += [option, str(file)]
        command = ["openssl", *map(str, arguments), *options]
        try:
            done = subprocess.run(command, check=False, capture_output=True, text=True)  # noqa: S603 - a fixed command
        except FileNotFoundError:
            raise MakeError("there is no openssl command; Debian's package is called openssl") from None
    if done.returncode:
        raise MakeError(f"openssl {arguments[0]}: {' '.join(done.stderr.split())}")


def main(arguments: list[str]) -> int:
    """Run the command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for everything")
    parser.add_argument("--router", action="append", required=True, metavar="HOST", help="name or address, repeatable")
    parser.add_argument("--service", action="append", default=[], metavar="NAME", help="a tracking service")
    parser.add_argument("--node", action="append", default=[], metavar="SITE/NODE", help="a perception node")
    parser.add_argument(
        "--reads", action="append", default=[], metavar="NODE=SESSION",
        help="session whose tracks, events and problems a node may read, as garage/kiosk=garage/fused/crossing",
    )  # fmt: skip
    parser.add_argument("--viewer", action="append", default=[], metavar="NAME", help="one who reads everything")
    parser.add_argument("--gateway", action="append", default=[], metavar="HOST", help="a gRPC gateway, on this host")
    parser.add_argument("--connect", metavar="ENDPOINT", help="where clients connect; default: tls/ROUTER:7447")
    parser.add_argument("--at", metavar="DIR", help="where each machine will have its folder; default: where it is now")
    parser.add_argument("--prefix", default="optipmb/v1", help="first chunks of every key")
    parser.add_argument("--days", type=int, default=90, help="how long certificates hold")
    parser.add_argument("--megabytes", type=float, default=16.0, help="largest message that the router takes")
    parser.add_argument("--rate", type=float, default=5000.0, help="most detections, and clouds, per second and link")
    parser.add_argument("--renew", action="store_true", help="new certificates, also where the present ones hold")
    try:
        for line in make(parser.parse_args(arguments)):
            print(line)
    except MakeError as error:
        print(f"make.py: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
