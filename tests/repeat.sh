#!/bin/sh
# Runs `make test` again and again in fresh clones of this repository, and says how often it passed and how long it took.
# Called as: sh tests/repeat.sh TIMES LOAD
#   LOAD  processes that compute all the time beside it
# The data beside this repository are used.
set -eu
times=$1
load=$2
root=$(cd "$(dirname "$0")/.." && pwd)
work=$(mktemp -d)
busy=
trap 'kill $busy 2>/dev/null || true; rm -rf "$work"' EXIT INT TERM
KITTI_ROOT=${KITTI_ROOT:-$(ls -d "$root"/../*/data/kitti 2>/dev/null | head -1)}
NUSCENES_ROOT=${NUSCENES_ROOT:-$(ls -d "$root"/../*/data/nuscenes 2>/dev/null | head -1)}
export KITTI_ROOT NUSCENES_ROOT
[ -d "$KITTI_ROOT" ] || unset KITTI_ROOT
[ -d "$NUSCENES_ROOT" ] || unset NUSCENES_ROOT
for _ in $(seq "$load"); do
  sh -c 'while :; do :; done' &
  busy="$busy $!"
done
# The environment is not what is tested: one serves all clones, which lie in the same place one after the other.
clone=$work/clone
VENV=$work/venv
passed=0
for number in $(seq "$times"); do
  rm -rf "$clone"
  git clone --quiet "$root" "$clone"
  [ ! -e "$VENV/.installed" ] || touch "$VENV/.installed"
  began=$(date +%s)
  make -s -C "$clone" install VENV="$VENV" >"$work/install.log" 2>&1 || { cat "$work/install.log"; exit 1; }
  installed=$(($(date +%s) - began))
  began=$(date +%s)
  if make -C "$clone" test VENV="$VENV" >"$work/$number.log" 2>&1; then
    passed=$((passed + 1))
    result=passed
  else
    result="failed:"
  fi
  echo "$number: $result $(($(date +%s) - began)) s, installed in $installed s $(grep -E '^(FAILED|ERROR)' "$work/$number.log" | head -5 | tr '\n' ' ')"
  [ "$result" = passed ] || cp "$work/$number.log" "$root/out/repeat-$number.log" 2>/dev/null || tail -50 "$work/$number.log"
done
echo "$passed of $times passed, $load processes beside it"
[ "$passed" = "$times" ]
