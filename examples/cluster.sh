#!/bin/sh
# The topology of docker/kubernetes as processes of this machine: a NATS server, two linked routers, two bridges into the
# log, and MEMBERS services, every second one at the other router. It needs `pip install '.[cluster]'`. Ctrl-C ends it.
#
#   sh examples/cluster.sh                       # in one terminal
#   optipmb replay --dataset scene               # in others
#   optipmb status --connect tcp/127.0.0.1:7448
set -u
MEMBERS=${MEMBERS:-2}
ROUTER_A=${ROUTER_A:-tcp/127.0.0.1:7447}
ROUTER_B=${ROUTER_B:-tcp/127.0.0.1:7448}
NATS=${NATS:-127.0.0.1:4222}
STORE=${STORE:-$(mktemp -d)}
service=${SERVICE:-optipmb-service}

all=
logs=$(mktemp -d)
end() {
  trap - INT TERM
  kill -TERM $all 2>/dev/null
  wait
  rm -r "$logs"
  exit "${1:-0}"
}
trap end INT TERM

# Start a process by a name; its log goes to the terminal and into a file.
start() {
  name=$1
  shift
  mkfifo "$logs/$name.pipe"
  tee -i "$logs/$name" < "$logs/$name.pipe" &
  "$service" "$@" > "$logs/$name.pipe" 2>&1 &
  all="$all $!"
  echo "$name" > "$logs/$!.name"
}

routers="--connect $ROUTER_A --connect $ROUTER_B"
start nats nats --listen "$NATS" --store "$STORE"
start router-0 router --instance router-0 --listen "$ROUTER_A" $routers
start router-1 router --instance router-1 --listen "$ROUTER_B" $routers
for number in 0 1; do
  start "log-$number" log --instance "log-$number" --cluster "nats://$NATS" $routers
done
for number in $(seq 0 $((MEMBERS - 1))); do
  router=$ROUTER_A
  [ $((number % 2)) = 0 ] || router=$ROUTER_B
  OPTIPMB_STORE=$STORE/service-$number start "service-$number" run --instance "service-$number" --cluster "nats://$NATS" --connect "$router"
done

# One that ends by itself takes all others along.
while :; do
  for one in $all; do
    kill -0 "$one" 2>/dev/null && continue
    name=$(cat "$logs/$one.name")
    echo "$name has ended; its last line: $(tail -n 1 "$logs/$name")" >&2
    end 1
  done
  sleep 1 & wait $!
done
