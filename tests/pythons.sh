#!/bin/sh
# Tests the wheel with every Python newer than 3.11 that is here: on the path, or kept by pyenv.
# Called as: sh tests/pythons.sh BIN
set -eu
here=$(dirname "$0")
tried=0
for minor in 12 13; do
  for python in "python3.$minor" "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3."$minor".*/bin/python3; do
    if "$python" -c "import sys, venv, ensurepip; sys.exit(sys.version_info[:2] != (3, $minor))" 2>/dev/null; then
      sh "$here/elsewhere.sh" "$python" "$1"
      tried=$((tried + 1))
      break
    fi
  done
done
[ "$tried" -gt 0 ] || echo "no Python 3.12 or 3.13 is here: nothing was tested with another than the usual one"
