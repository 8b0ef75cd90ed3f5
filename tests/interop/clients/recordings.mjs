// Reads a recording as Foxglove does: node recordings.mjs NODE_MODULES FILE. A line for each message, in the file's
// order by time, and at last one with the sources.
import { createHash } from "node:crypto";
import { open } from "node:fs/promises";
import { createRequire } from "node:module";

const [modules, path] = process.argv.slice(2);
const require = createRequire(`${modules}/x.js`);
const say = (event) => console.log(`@ ${JSON.stringify(event)}`);

// What each type of the tests says in few words.
const words = (message) =>
  message.transforms?.map((each) => each.child_frame_id) ??
  (message.encoding ? [message.width, message.height, message.encoding] : (message.words ?? [message.data]));
const row = (at, topic, type, data, message) => ({
  event: "message",
  at: String(at),
  topic,
  type,
  digest: createHash("sha1").update(data).digest("hex"),
  words: [...words(message)],
});

if (path.endsWith(".bag")) {
  const { Bag } = require("@foxglove/rosbag");
  const { FileReader } = require("@foxglove/rosbag/node");
  const bag = new Bag(new FileReader(path));
  await bag.open();
  const types = new Map([...bag.connections.values()].map((one) => [one.topic, one.type]));
  for await (const { timestamp, topic, data, message } of bag.messageIterator({})) {
    const at = BigInt(timestamp.sec) * 1_000_000_000n + BigInt(timestamp.nsec);
    say(row(at, topic, types.get(topic), data, message));
  }
  const sources = [...bag.connections.values()].map((one) => [one.topic, one.callerid, Boolean(one.latching)]);
  say({ event: "sources", sources });
} else {
  const { McapIndexedReader } = require("@mcap/core");
  const { loadDecompressHandlers } = require("@mcap/support");
  const { parse } = require("@foxglove/rosmsg");
  const { MessageReader } = require("@foxglove/rosmsg-serialization");
  const file = await open(path);
  const size = BigInt((await file.stat()).size);
  const read = async (offset, length) => {
    const bytes = new Uint8Array(Number(length));
    await file.read(bytes, 0, bytes.length, Number(offset));
    return bytes;
  };
  const readable = { size: async () => size, read };
  const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers: await loadDecompressHandlers() });
  const codecs = new Map();
  for await (const { channelId, logTime, data } of reader.readMessages()) {
    const channel = reader.channelsById.get(channelId);
    const schema = reader.schemasById.get(channel.schemaId);
    if (!codecs.has(schema.id))
      codecs.set(schema.id, new MessageReader(parse(new TextDecoder().decode(schema.data))));
    say(row(logTime, channel.topic, schema.name, data, codecs.get(schema.id).readMessage(data)));
  }
  const sources = [...reader.channelsById.values()].map(({ topic, metadata }) => [
    topic,
    metadata.get("callerid"),
    metadata.get("latching") === "1",
    metadata.get("module"),
  ]);
  say({ event: "sources", sources });
  await file.close();
}
