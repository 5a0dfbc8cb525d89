#!/bin/sh
# Builds wheels with machine code beside the wheel that is in DIST: sh packaging/wheels.sh DIST [PYTHON...]
# Each is for one Python (by default for each on this machine, on the path or kept by pyenv), for the version of numba that
# pip installs here, and for processors of x86-64-v2 and newer. Elsewhere its kernels are compiled, as those of the wheel
# without machine code, which is installed into an empty environment of each Python to compile them.
set -eu
dist=$(cd "$1" && pwd)
shift
root=$(cd "$(dirname "$0")/.." && pwd)
if [ $# -eq 0 ]; then
  for minor in 11 12 13 14; do
    for python in "python3.$minor" "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3."$minor".*/bin/python3; do
      if "$python" -c "import sys, venv, ensurepip; sys.exit(sys.version_info[:2] != (3, $minor))" 2>/dev/null; then
        set -- "$@" "$python"
        break
      fi
    done
  done
fi
source=$(ls "$dist"/optipmb-*.tar.gz 2>/dev/null || echo "$root") # the archive at a release
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT INT TERM
for python; do
  rm -rf "$work/venv" "$work/cache" "$work/code"
  "$python" -m venv "$work/venv"
  pip="$work/venv/bin/python -m pip --quiet --disable-pip-version-check"
  $pip install --find-links "$dist" "$dist"/optipmb-*-none-any.whl
  export NUMBA_CACHE_DIR="$work/cache" NUMBA_CPU_NAME=x86-64-v2 NUMBA_CPU_FEATURES=
  (cd "$work" && venv/bin/python -c 'import optipmb; optipmb.warm_up(rejoin=True)')
  # Kernels that kernels alone call are compiled into those: what a second process loads is enough.
  mkdir "$work/code"
  for kernel in $(cd "$work" && venv/bin/python -c '
import optipmb, optipmb.warm
optipmb.warm_up(rejoin=True)
print(*(".".join(name.split(".")[-2:]) for name, one in optipmb.warm.kernels().items() if one.stats.cache_hits))'); do
    cp "$work"/cache/*/"$kernel"-*.nb[ci] "$work/code"
  done
  OPTIPMB_MACHINE_CODE=$work/code $pip wheel --no-deps --wheel-dir "$dist" "$source"
done
