#!/bin/sh
# Installs the wheel into a fresh environment, other than the one it was developed in, and runs tests against it there.
# Called as: sh tests/elsewhere.sh PYTHON DIST [CONSTRAINTS]
#   PYTHON       interpreter that makes the fresh environment
#   DIST         folder with the wheel
#   CONSTRAINTS  versions to install; the newest that pyproject.toml allows by default
set -eu
python=$1
wheel=$(ls "$2"/optipmb-*-none-any.whl)
root=$(cd "$(dirname "$0")/.." && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT INT TERM
constraints=${3:-/dev/null}

"$python" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install --quiet --disable-pip-version-check --constraint "$constraints" \
  "$wheel[grpc,plot,record,service,table,traces,tune]" hypothesis pytest pytest-asyncio pytest-timeout pytest-xdist \
  foxglove-schemas-protobuf mcap-protobuf-support mcap-ros2-support websocket-client
"$work/venv/bin/python" -m pip check --disable-pip-version-check
mkdir "$work/away" && cd "$work/away" # nothing of the source tree is importable from here, but for what tests share
unset PYTHONPATH
"$work/venv/bin/optipmb" warm-up
# What packages of others warn of among themselves is theirs: the versions here are combined by nobody else.
# One file or folder for each package of others that the product rests on.
"$work/venv/bin/python" -m pytest -W ignore::DeprecationWarning -c "$root/pyproject.toml" --rootdir "$root" -o cache_dir="$work/cache" -q -n 3 --dist loadfile --timeout 300 \
  "$root"/tests/e2e/test_processes.py "$root"/tests/service/zenoh "$root"/tests/service/http/test_http.py "$root"/tests/grpc/test_track.py "$root"/tests/service/stream/test_traces.py \
  "$root"/tests/tracker/test_oracle.py "$root"/tests/schemas/test_codec.py \
  "$root"/tests/clients/test_api.py "$root"/tests/clients/test_cli.py "$root"/tests/clients/test_mcap_files.py "$root"/tests/clients/test_tuning_study.py
"$work/venv/bin/python" --version
echo "the wheel works there"
