// Reads a capture as docs/captures.md says, and prints what it found as JSON.
import { McapIndexedReader, McapStreamReader } from "@mcap/core";
import { decode } from "@msgpack/msgpack";
import { decompress } from "fzstd";
import { open, readFile } from "node:fs/promises";

const [path, how] = process.argv.slice(2);
const decompressHandlers = { zstd: (packed, size) => decompress(packed, new Uint8Array(Number(size))) };
const found = { keys: {}, metadata: {}, frames: [], problem: "" };
const channels = new Map();
const schemas = new Map();

function take(message) {
  const channel = channels.get(message.channelId);
  const schema = schemas.get(channel.schemaId);
  const key = (found.keys[channel.topic] ??= {
    type: schema?.name ?? "", encoding: channel.messageEncoding, messages: 0, stamps: [], unknown: [], last: "0",
  });
  key.messages += 1;
  if (message.logTime < BigInt(key.last)) throw new Error(`${channel.topic}: log times go back`);
  key.last = String(message.logTime);
  if (channel.messageEncoding !== "msgpack") return;
  const value = decode(message.data, { useBigInt64: true });
  const stamp = BigInt(value.stamp_ns ?? 0);
  if (stamp !== 0n && stamp !== message.publishTime) throw new Error(`${channel.topic}: publish time is no stamp`);
  if (value.seq !== undefined && BigInt(value.seq) % 4294967296n !== BigInt(message.sequence))
    throw new Error(`${channel.topic}: sequence is not seq`);
  key.stamps.push(String(stamp));
  if (schema) {
    const fields = JSON.parse(new TextDecoder().decode(schema.data)).properties;
    for (const name of Object.keys(value)) if (!(name in fields) && !key.unknown.includes(name)) key.unknown.push(name);
  }
  if (channel.topic.endsWith("/kinect/frame")) {
    const depth = new DataView(value.depth.buffer, value.depth.byteOffset, value.depth.byteLength);
    const middle = 2 * (Number(value.width) * Math.floor(Number(value.height) / 2) + Math.floor(Number(value.width) / 2));
    found.frames.push([Number(value.width), Number(value.height), value.colour.length, depth.getUint16(middle, true)]);
  }
}

if (how === "indexed") {
  const file = await open(path);
  const readable = {
    size: async () => BigInt((await file.stat()).size),
    read: async (offset, size) => {
      const buffer = new Uint8Array(Number(size));
      await file.read(buffer, 0, Number(size), Number(offset));
      return buffer;
    },
  };
  const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
  for (const [id, channel] of reader.channelsById) channels.set(id, channel);
  for (const [id, schema] of reader.schemasById) schemas.set(id, schema);
  for await (const record of reader.readMetadata()) found.metadata[record.name] = Object.fromEntries(record.metadata);
  for await (const message of reader.readMessages()) take(message);
  await file.close();
} else {
  const reader = new McapStreamReader({ decompressHandlers, validateCrcs: true });
  try {
    reader.append(await readFile(path));
    for (let record; (record = reader.nextRecord()); ) {
      if (record.type === "Schema") schemas.set(record.id, record);
      else if (record.type === "Channel") channels.set(record.id, record);
      else if (record.type === "Metadata") found.metadata[record.name] = Object.fromEntries(record.metadata);
      else if (record.type === "Message") take(record);
    }
  } catch (error) {
    found.problem = String(error.message);
  }
}
process.stdout.write(JSON.stringify(found));
