#!/bin/bash
# A car drives past at 10 m/s, seen by a radar that speaks MQTT and by a lidar that speaks HTTP.
set -eu
for x in $(seq 0 60); do
  echo '{"stamp_ns": '$(date +%s%N)', "objects": [{"class": "car", "position": ['$x', 0], "size": [4.4, 1.8, 1.5], "yaw": 0}]}'
  sleep 0.1
done | mosquitto_pub -t radar/objects -q 1 -l

for x in $(seq 0 60); do
  curl -s -o /dev/null 'http://127.0.0.1:8080/api/v1/detections?stream=garage/gate/lidar' -H 'content-type: application/json' \
    -d '{"stamp_ns": '$(date +%s%N)', "objects": [{"class": "car", "position": ['$x', 0], "size": [4.4, 1.8, 1.5], "yaw": 0}]}'
  sleep 0.1
done
