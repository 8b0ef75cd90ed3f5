// Decodes what the Foxglove gateway sends by @foxglove/rosmsg and @foxglove/rosmsg-serialization, and encodes it again:
// node decode.mjs NODE_MODULES URL PREFIX. A line for each message of a topic below PREFIX; it runs until it is ended.
import { createRequire } from "node:module";

const [modules, url, prefix] = process.argv.slice(2);
const require = createRequire(`${modules}/x.js`);
const { FoxgloveClient } = require("@foxglove/ws-protocol");
const { parse } = require("@foxglove/rosmsg");
const { MessageReader, MessageWriter } = require("@foxglove/rosmsg-serialization");
const { WebSocket } = require("ws");

const plain = (_, value) =>
  typeof value === "bigint" ? Number(value) : ArrayBuffer.isView(value) ? Array.from(value, Number) : value;
const client = new FoxgloveClient({ ws: new WebSocket(url, [FoxgloveClient.SUPPORTED_SUBPROTOCOL]) });
const topics = new Map();
client.on("error", (error) => {
  throw error;
});
client.on("advertise", (channels) => {
  for (const channel of channels.filter((each) => each.topic.startsWith(prefix))) {
    const definitions = parse(channel.schema);
    const codec = { channel, reader: new MessageReader(definitions), writer: new MessageWriter(definitions) };
    topics.set(client.subscribe(channel.id), codec);
  }
});
client.on("message", ({ subscriptionId, data }) => {
  const { channel, reader, writer } = topics.get(subscriptionId);
  const values = reader.readMessage(data);
  const event = {
    event: "message",
    topic: channel.topic,
    type: channel.schemaName,
    received: Buffer.from(data.buffer, data.byteOffset, data.byteLength).toString("hex"),
    again: Buffer.from(writer.writeMessage(values)).toString("hex"),
    values,
  };
  console.log(`@ ${JSON.stringify(event, plain)}`);
});
