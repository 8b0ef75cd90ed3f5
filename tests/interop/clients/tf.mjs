// TFClient of roslib 1 and 2, and ROS2TFClient of roslib 2, as they are: node tf.mjs PACKAGE URL
import assert from "node:assert";
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { pathToFileURL } from "node:url";

const [home, url] = process.argv.slice(2);
const about = JSON.parse(readFileSync(`${home}/package.json`));
if (!about.dependencies.ws) globalThis.WebSocket ??= createRequire(home)("ws");
const entry = about.exports?.["."] ?? about.main;
const module = await import(pathToFileURL(`${home}/${entry.import?.default ?? entry.import ?? entry}`));
const ROSLIB = module.Topic ? module : module.default;
const within = (promise, what) =>
  Promise.race([promise, new Promise((_, no) => setTimeout(() => no(new Error(`${what}: no answer`)), 20000))]);

const ros = new ROSLIB.Ros({ url });
await within(new Promise((yes, no) => (ros.on("connection", yes), ros.on("error", no))), "connection");

const options = { ros, fixedFrame: "odom", rate: 20, angularThres: 0.01, transThres: 0.01 };
const clients = [() => new ROSLIB.TFClient(options)];
// Of roslib 1: the service, which it uses where it is told that the server is not of Groovy's time.
if (!ROSLIB.ROS2TFClient) clients.push(() => ((ros.groovyCompatibility = false), new ROSLIB.TFClient(options)));
else clients.push(() => new ROSLIB.ROS2TFClient(options));
for (const make of clients) {
  const client = make();
  const seen = { base: [], laser: [] };
  await within(
    new Promise((done) => {
      for (const frame of Object.keys(seen))
        client.subscribe(`/${frame}`, ({ translation }) => {
          seen[frame].push(translation.x);
          if (seen.base.length > 5 && seen.laser.length > 5) done();
        });
    }),
    "transforms",
  );
  assert.ok(seen.base.at(-1) > seen.base[0], `${seen.base}`); // it moves
  assert.ok(seen.laser.every((x, n) => n === 0 || x > seen.laser[n - 1]), `${seen.laser}`);
  client.dispose();
}
ros.close();
console.log("ok");
process.exit(0);
