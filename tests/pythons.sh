#!/bin/sh
# Tests the wheel with the newest Python beyond 3.11 on this machine: on the path, or kept by pyenv.
# Called as: sh tests/pythons.sh DIST
set -eu
here=$(dirname "$0")
for minor in 13 12; do
  for python in "python3.$minor" "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3."$minor".*/bin/python3; do
    if "$python" -c "import sys, venv, ensurepip; sys.exit(sys.version_info[:2] != (3, $minor))" 2>/dev/null; then
      exec sh "$here/elsewhere.sh" "$python" "$1"
    fi
  done
done
echo "no Python 3.12 or 3.13 is here: the wheel was tested with the usual one alone"
