#!/bin/sh
# Starts a service on a free port, puts two loads on it, says what memory it took, ends it.
# usage: load.sh BIN     SERVICE="--workers 2" SECONDS_EACH=60 ENDPOINT=tcp/127.0.0.1:7497 may be set before
set -eu
bin=$1
endpoint=${ENDPOINT:-tcp/127.0.0.1:7497}
seconds=${SECONDS_EACH:-30}
folder=$(mktemp -d)
OPTIPMB_STORE="$folder/store" "$bin/optipmb-service" --listen "$endpoint" --instance load --log-level warning ${SERVICE:-} >"$folder/out" &
service=$!
trap 'kill $service 2>/dev/null; wait $service || true; rm -rf "$folder"' EXIT INT TERM
until grep -q ready "$folder/out"; do kill -0 $service; sleep 0.2; done
echo "load of the machine before: $(cut -d " " -f 1 /proc/loadavg)"
status=0
for load in "--streams 40 --rate 10 --objects 40" "--streams 10 --rate 10 --objects 40 --points 30000"; do
  echo "load.py $load --seconds $seconds"
  "$bin/python" benchmarks/load.py --connect "$endpoint" $load --seconds "$seconds" --latency-ms 20 || status=$?
done
for process in $service $(pgrep -P $service || true); do
  echo "process $process: $(grep VmRSS "/proc/$process/status" | tr -s "\t " " ")"
done
exit $status
