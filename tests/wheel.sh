#!/bin/sh
# Installs the wheel with machine code alone into a fresh environment, and uses it from there: what the source tree adds
# is not there, so that a file missing from the wheel shows, and nothing may be compiled. Called as: sh tests/wheel.sh PYTHON BIN DIST
#   PYTHON  interpreter that makes the fresh environment
#   BIN     folder of an environment with pip
#   DIST    folder with both wheels, without machine code
set -eu
python=$1
case $2 in /*) bin=$2 ;; *) bin=$PWD/$2 ;; esac
root=$(cd "$(dirname "$0")/.." && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT INT TERM
mkdir "$work/dist" "$work/home"
cp "$3"/optipmb-*-none-any.whl "$work/dist"
node=$(cd "$3" && ls "$PWD"/optipmb_node-*.whl)
PIP_CONSTRAINT=$root/requirements.lock sh "$root/packaging/wheels.sh" "$work/dist" "$python"
wheel=$(ls "$work"/dist/optipmb-*-manylinux*.whl)

"$python" -m venv --without-pip "$work/venv"
"$bin/python" -m pip --python "$work/venv/bin/python" install --quiet --no-compile --disable-pip-version-check \
  --constraint "$root/requirements.lock" "$wheel[service]"

cd "$work" # nothing of the source tree is importable from here
unset PYTHONPATH NUMBA_CACHE_DIR
export HOME="$work/home"
"$work/venv/bin/python" - <<'PYTHON'
from pathlib import Path

import optipmb
import optipmb_client
import optipmb_schemas
import optipmb_service
import optipmb_tools

for package in (optipmb, optipmb_client, optipmb_schemas, optipmb_service, optipmb_tools):
    folder = Path(package.__file__).parent
    assert "site-packages" in folder.parts, folder
    assert (folder / "py.typed").is_file(), f"{folder.name} lacks py.typed: its users' type checkers see nothing"
for profile in ("kitti", "nuscenes"):
    assert optipmb.load_profile(profile).classes, profile
PYTHON
"$work/venv/bin/python" -c 'import optipmb; assert optipmb.warm_up(rejoin=True) == 0, "kernels were compiled"'
"$work/venv/bin/optipmb" --help >/dev/null
"$work/venv/bin/optipmb" --version
"$work/venv/bin/optipmb-service" --help >/dev/null
"$work/venv/bin/optipmb" track --dataset scene --option frames=5 --profile generic --out "$work/out" >/dev/null 2>"$work/said"
test -s "$work/out/0000.txt"
if grep compil "$work/said"; then exit 1; fi
"$bin/python" -m pip --python "$work/venv/bin/python" check --disable-pip-version-check

# At a release the two packages share no file: one can be removed, and the other still imports.
"$bin/python" -m build --outdir "$work/release" "$root" >/dev/null
"$bin/python" -m pip --python "$work/venv/bin/python" uninstall --quiet --yes optipmb
"$bin/python" -m pip --python "$work/venv/bin/python" install --quiet --no-deps "$work"/release/optipmb-*-none-any.whl "$node"
"$work/venv/bin/python" -c 'import optipmb_tools, optipmb_client'
"$bin/python" -m pip --python "$work/venv/bin/python" check --disable-pip-version-check
"$bin/python" -m pip --python "$work/venv/bin/python" uninstall --quiet --yes optipmb
"$work/venv/bin/python" -c 'import optipmb_client, optipmb_schemas; assert optipmb_client.Publisher'
echo "the wheel $(basename "$wheel") works by itself"
