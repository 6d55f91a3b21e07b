// The smallest subscriber: print where the object is whenever a touch has ended.
// Node from 18 on: npm install; node subscribe.mjs
import { decode } from "@msgpack/msgpack";
import { Subscriber } from "zeromq";

const CONVERGED = 3; // of `status`: docs/stream.md has all numbers
const socket = new Subscriber();
// of the service, and of a daemon that this user runs: whichever is there, or comes later
const own = `ipc://${process.env.XDG_RUNTIME_DIR ?? "/nowhere"}/taxeld/stream`;
for (const endpoint of process.argv[2] ? [process.argv[2]] : ["ipc:///run/taxeld/stream", own]) {
  socket.connect(endpoint);
  console.error(`listening at ${endpoint}`);
}
socket.subscribe("/taxeld/estimate");
let touching = false;
for await (const [, body] of socket) {
  const estimate = decode(body);
  const usable = estimate.valid && estimate.status === CONVERGED;
  if (touching && !estimate.contact && usable) {
    const { x, y, theta } = estimate.map;
    const at = `x ${x.toFixed(3)} m  y ${y.toFixed(3)} m  yaw ${theta.toFixed(2)}`;
    const [[named]] = Object.entries(estimate.objects).sort((a, b) => b[1] - a[1]);
    console.log(`${at}  p ${estimate.p.toFixed(3)}  ${named}`);
  }
  touching = estimate.contact;
}
