"""Coverage-guided search for bytes that a decoder neither reads nor refuses.

Run it as `python search.py TARGET SECONDS [OPTION...]`; further options go to libFuzzer. It goes on from the
results of earlier searches (out/fuzz), and from the kept files in this folder. Its findings go to `found/TARGET`,
where the tests take it up, and ends.
"""

import sys
from pathlib import Path

import atheris

HERE = Path(__file__).parent
LEARNED = HERE.parents[1] / "out" / "fuzz"
sys.path[:0] = [str(HERE), str(HERE.parent / "support")]

from mutation import mutated  # noqa: E402 - of this folder

import optipmb  # noqa: E402 - first, and not instrumented: its kernels are compiled

with atheris.instrument_imports(include=["optipmb_schemas", "optipmb_service"]):
    from targets import HEADS, TARGETS


def main(name: str, seconds: str, *options: str) -> None:
    optipmb.warm_up()  # which may take longer than any bytes should
    learned, found, corpus = LEARNED / name, HERE / "found" / name, HERE / "corpus" / name
    for folder in (learned, found):
        folder.mkdir(parents=True, exist_ok=True)
    longest = max(path.stat().st_size for path in corpus.iterdir())
    limits = (f"-max_total_time={seconds}", f"-max_len={3 * longest}", "-timeout=100", "-rss_limit_mb=4096")
    given = (*limits, f"-artifact_prefix={found}/", "-print_final_stats=1", *options)

    def mutate(data: bytes, size: int, seed: int) -> bytes:
        return mutated(data, size, seed, atheris.Mutate, head=HEADS[name])

    atheris.Setup([sys.argv[0], *given, *map(str, (learned, corpus, found))], TARGETS[name], custom_mutator=mutate)
    atheris.Fuzz()


if __name__ == "__main__":
    main(*sys.argv[1:])
