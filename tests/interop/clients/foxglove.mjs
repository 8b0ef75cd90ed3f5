// @foxglove/ws-protocol's client against the Foxglove gateway: node foxglove.mjs NODE_MODULES URL
import assert from "node:assert";
import { createRequire } from "node:module";

const [modules, url] = process.argv.slice(2);
const require = createRequire(`${modules}/x.js`);
const { FoxgloveClient } = require("@foxglove/ws-protocol");
const { WebSocket } = require("ws");

const client = new FoxgloveClient({ ws: new WebSocket(url, [FoxgloveClient.SUPPORTED_SUBPROTOCOL]) });
const waiting = [];
for (const event of ["serverInfo", "message", "parameterValues", "serviceCallResponse", "connectionGraphUpdate", "status", "error"]) {
  client.on(event, (value) => {
    if (event === "error") throw value;
    for (const each of [...waiting]) if (each.event === event && each.fits(value)) {
      waiting.splice(waiting.indexOf(each), 1);
      each.yes(value);
    }
  });
}
const next = (event, fits = () => true) =>
  Promise.race([
    new Promise((yes) => waiting.push({ event, fits, yes })),
    new Promise((_, no) => setTimeout(() => no(new Error(`no ${event}`)), 20000)),
  ]);
const channels = new Map();
const services = new Map();
client.on("advertise", (list) => list.forEach((each) => channels.set(each.topic, each)));
client.on("unadvertise", (ids) => channels.forEach((each, topic) => ids.includes(each.id) && channels.delete(topic)));
client.on("advertiseServices", (list) => list.forEach((each) => services.set(each.name, each)));
const until = async (fits, what) => {
  for (let round = 0; !fits(); round++) {
    assert.ok(round < 400, `no ${what}`);
    await new Promise((yes) => setTimeout(yes, 50));
  }
};

const info = await next("serverInfo");
assert.equal(info.metadata.ROS_DISTRO, "noetic");
assert.deepEqual(info.supportedEncodings, ["ros1"]);

// A topic that this client publishes comes back as a channel.
const published = client.advertise({ topic: "/out", encoding: "ros1", schemaName: "std_msgs/String" });
await until(() => channels.has("/out"), "channel /out");
const channel = channels.get("/out");
assert.equal(channel.schemaName, "std_msgs/String");
assert.equal(channel.schemaEncoding ?? "ros1msg", "ros1msg");
const subscription = client.subscribe(channel.id);
await new Promise((yes) => setTimeout(yes, 200));
const data = new Uint8Array([3, 0, 0, 0, 111, 110, 101]);
const message = next("message", (each) => each.subscriptionId === subscription);
client.sendMessage(published, data);
const { data: view } = await message;
assert.deepEqual([...new Uint8Array(view.buffer, view.byteOffset, view.byteLength)], [...data]);
client.unsubscribe(subscription);

// Parameters.
client.subscribeParameterUpdates(["/p"]);
const set = next("parameterValues", (each) => each.id === "set");
client.setParameters([{ name: "/p", value: 4.5 }], "set");
assert.equal((await set).parameters[0].value, 4.5);
const got = next("parameterValues", (each) => each.id === "get");
client.getParameters(["/p"], "get");
assert.equal((await got).parameters[0].value, 4.5);

// A service of the core's node.
await until(() => services.has("/rosout/get_loggers") || services.size > 0, "service");
const service = services.get("/rosout/get_loggers") ?? [...services.values()].find((each) => each.type === "roscpp/GetLoggers");
if (service) {
  const response = next("serviceCallResponse", (each) => each.callId === 1);
  client.sendServiceCallRequest({ serviceId: service.id, callId: 1, encoding: "ros1", data: new DataView(new ArrayBuffer(0)) });
  assert.equal((await response).serviceId, service.id);
}

// The graph.
const graph = next("connectionGraphUpdate");
client.subscribeConnectionGraph();
assert.ok((await graph).publishedTopics.some((each) => each.name === "/out" && each.publisherIds.some((id) => id.startsWith("/rmpa_web"))));

client.close();
console.log("ok");
process.exit(0);
