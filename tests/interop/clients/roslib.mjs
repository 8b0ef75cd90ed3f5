// roslibjs (roslib 1.x and 2.x, @foxglove/roslibjs) against the rosbridge gateway: node roslib.mjs PACKAGE URL
import assert from "node:assert";
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { pathToFileURL } from "node:url";

const [home, url] = process.argv.slice(2);
const about = JSON.parse(readFileSync(`${home}/package.json`));
if (!about.dependencies.ws) globalThis.WebSocket ??= createRequire(home)("ws"); // made for browsers, which have it
const entry = about.exports?.["."] ?? about.main;
const module = await import(pathToFileURL(`${home}/${entry.import?.default ?? entry.import ?? entry}`));
const ROSLIB = module.Topic ? module : module.default;
const message = (values) => (ROSLIB.Message ? new ROSLIB.Message(values) : values);
const within = (promise, what) =>
  Promise.race([promise, new Promise((_, no) => setTimeout(() => no(new Error(`${what}: no answer`)), 20000))]);
const called = (what, call) => within(new Promise((yes, no) => call(yes, no)), what);

const ros = new ROSLIB.Ros({ url });
await called("connection", (yes, no) => (ros.on("connection", yes), ros.on("error", no)));

// Topics: in JSON, CBOR, and throttled by the client's own queue.
const pictures = about.dependencies.pngparse || about.dependencies["fast-png"] ? ["png"] : [];
for (const [index, compression] of ["none", "cbor", ...pictures].entries()) {
  const name = `/chatter${index}`;
  const type = "std_msgs/String";
  const listener = new ROSLIB.Topic({ ros, name, messageType: type, compression });
  const talker = new ROSLIB.Topic({ ros, name, messageType: type, latch: true });
  const heard = called(compression, (yes) => listener.subscribe(yes));
  talker.publish(message({ data: `hello ${compression}` }));
  assert.equal((await heard).data, `hello ${compression}`);
  listener.unsubscribe();
  talker.unadvertise();
}

// Arrays of bytes and of floats.
{
  const name = "/cloud";
  const options = { ros, name, messageType: "sensor_msgs/LaserScan" };
  const listener = new ROSLIB.Topic({ ...options, compression: "cbor" });
  const talker = new ROSLIB.Topic(options);
  const heard = called(name, (yes) => listener.subscribe(yes));
  talker.publish(message({ ranges: [1.5, 2.5], intensities: [] }));
  const scan = await heard;
  assert.deepEqual([...scan.ranges], [1.5, 2.5]);
  listener.unsubscribe();
}

// Services: one that this client offers, called by itself, and an error.
const offered = new ROSLIB.Service({ ros, name: "/set", serviceType: "std_srvs/SetBool" });
offered.advertise((request, response) => {
  response.success = request.data;
  response.message = "done";
  return true;
});
const client = new ROSLIB.Service({ ros, name: "/set", serviceType: "std_srvs/SetBool" });
for (let attempt = 0; ; attempt++) {
  try {
    const answer = await called("/set", (yes, no) => client.callService({ data: true }, yes, no));
    assert.deepEqual({ ...answer }, { success: true, message: "done" });
    break;
  } catch (error) {
    if (attempt === 100 || error instanceof assert.AssertionError) throw error;
    await new Promise((yes) => setTimeout(yes, 50));
  }
}
const absent = new ROSLIB.Service({ ros, name: "/absent", serviceType: "std_srvs/Empty" });
const said = []; // by the library itself: it has no handler for a frame beside the answer
for (const how of ["log", "warn", "error"]) console[how] = ((plain) => (...words) => (said.push(words.join(" ")), plain(...words)))(console[how]);
const emit = ros.emit;
ros.emit = function (event, ...rest) { if (String(event).startsWith("status")) said.push(`${event} ${JSON.stringify(rest)}`); return emit.call(this, event, ...rest); };
const refusal = await called("/absent", (yes, no) => absent.callService({}, () => no(new Error("answered")), yes));
assert.match(String(refusal), /\/absent/);
assert.deepEqual(said, []);

// Parameters and the graph.
const param = new ROSLIB.Param({ ros, name: "/a/number" });
await called("set", (yes) => param.set(4.5, yes));
assert.equal(await called("get", (yes) => param.get(yes)), 4.5);
await called("delete", (yes) => param.delete(yes));
assert.equal(await called("get again", (yes) => param.get(yes)), null);
const topics = await called("topics", (yes, no) => ros.getTopics(yes, no));
assert.ok(topics.topics.includes("/rosout"));
assert.equal(topics.types[topics.topics.indexOf("/rosout")], "rosgraph_msgs/Log");
const nodes = await called("nodes", (yes, no) => ros.getNodes(yes, no));
assert.ok(nodes.some((each) => each.startsWith("/rmpa_web")));
const raw = await called("raw types", (yes, no) => ros.getTopicsAndRawTypes(yes, no));
assert.match(raw.typedefs_full_text[raw.topics.indexOf("/rosout")], /byte level/);
const details = await called("details", (yes, no) => ros.getMessageDetails("geometry_msgs/Twist", yes, no));
assert.deepEqual(details.map((each) => each.type), ["geometry_msgs/Twist", "geometry_msgs/Vector3"]);
assert.deepEqual(Object.keys(ros.decodeTypeDefs(details.slice(1))), ["x", "y", "z"]);
await called("time", (yes, no) => ros.getServices(yes, no));

ros.close();
console.log("ok");
process.exit(0);
