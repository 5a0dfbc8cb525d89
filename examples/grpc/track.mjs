// Track over gRPC from the .proto file alone, in Node: a car that drives along x at 10 m/s, seen ten times a second.
// npm ci --ignore-scripts; node track.mjs ../../schemas/proto/optipmb/v1/tracking.proto
import { randomBytes } from "node:crypto";
import grpc from "@grpc/grpc-js";
import loader from "@grpc/proto-loader";

const schema = loader.loadSync(process.argv[2], { keepCase: true, longs: String, oneofs: true });
const { TrackingService } = grpc.loadPackageDefinition(schema).optipmb.v1;
const client = new TrackingService("127.0.0.1:50051", grpc.credentials.createInsecure());

const epoch = randomBytes(16); // new at every start
const start = BigInt(Date.now()) * 1_000_000n;
const doubles = (shape, ...values) => ({ dtype: "DATA_TYPE_F8", shape, data: Buffer.from(Float64Array.from(values).buffer) });
const integers = (...values) => ({ dtype: "DATA_TYPE_I4", shape: [values.length], data: Buffer.from(Int32Array.from(values).buffer) });

const frame = (seq) => ({
  detections: {
    stream: "garage/robot-1/camera",
    epoch,
    seq: String(seq),
    stamp_ns: String(start + BigInt(seq) * 100_000_000n),
    frame: "FRAME_WORLD",
    labels: ["car"],
    label: integers(0),
    center: doubles([1, 3], seq * 1.0, 0.0, 0.8),
    size: doubles([1, 3], 4.5, 1.9, 1.6),
    yaw: doubles([1], 0.0),
    score: doubles([1], 0.9),
  },
});

const call = client.Track();
call.on("data", ({ tracks, problem }) => {
  if (problem) return console.log("problem", problem.message);
  for (let row = 0; row < (tracks.id.shape ?? [0])[0]; row++) {
    const [x, y] = [0, 1].map((column) => tracks.center.data.readDoubleLE((3 * row + column) * 8).toFixed(1));
    console.log("frame", tracks.seq, "track", tracks.id.data.readBigInt64LE(8 * row).toString(), "at", x, y);
  }
});
call.on("error", (error) => {
  console.error(error.code, error.details);
  process.exitCode = 1;
});
call.on("end", () => client.close());
for (let seq = 0; seq < 50; seq++) call.write(frame(seq));
call.end();
