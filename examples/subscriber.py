"""Print the tracks of all sensors in the garage until nothing comes for five seconds."""

from optipmb_client import Subscriber

with Subscriber("garage/*/*", connect="tcp/127.0.0.1:7447", timeout=5) as tracks:
    for message in tracks:
        for track, label, (x, y, z) in zip(message.id, message.label, message.center, strict=True):
            print(message.stream, "track", track, message.labels[label], f"at {x:.1f} {y:.1f} {z:.1f}", flush=True)
