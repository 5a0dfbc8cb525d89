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
end() {
  trap - INT TERM
  kill -TERM $all 2>/dev/null
  wait
  exit "${1:-0}"
}
trap end INT TERM

start() {
  "$service" "$@" &
  all="$all $!"
}

routers="--connect $ROUTER_A --connect $ROUTER_B"
start nats --listen "$NATS" --store "$STORE"
start router --instance router-0 --listen "$ROUTER_A" $routers
start router --instance router-1 --listen "$ROUTER_B" $routers
for number in 0 1; do
  start log --instance "log-$number" --cluster "nats://$NATS" $routers
done
for number in $(seq 0 $((MEMBERS - 1))); do
  router=$ROUTER_A
  [ $((number % 2)) = 0 ] || router=$ROUTER_B
  OPTIPMB_STORE=$STORE/service-$number start run --instance "service-$number" --cluster "nats://$NATS" --connect "$router"
done

# One that ends by itself takes all others along.
while :; do
  for one in $all; do
    kill -0 "$one" 2>/dev/null || { echo "process $one has ended" >&2; end 1; }
  done
  sleep 1 & wait $!
done
