// Live messages of one topic: the newest value, plots of any number in it, images, and what a map has layers of.

import { html, useEffect, useRef, useState } from "./markup.js";
import { bytes, clock } from "./format.js";
import { Choice, Failure, Panel } from "./parts.js";
import { Plot, append } from "./plot.js";
import { LAYERS } from "./layers.js";
import { TopicMap } from "./pages/map.js";
import { MessageTree } from "./tree.js";

export const IMAGES = ["sensor_msgs/Image", "sensor_msgs/CompressedImage"];
const MOST_LINES = 8;

export function Live({ connection, topic, type, state }) {
  const [on, setOn] = useState(false);
  const [fields, setFields] = useState([]);
  const view = IMAGES.includes(type) ? "image" : type in LAYERS || type === "geometry_msgs/Pose" ? "map" : "";
  const toggle = (path) =>
    setFields((before) =>
      before.includes(path) ? before.filter((each) => each !== path) : [...before, path].slice(-MOST_LINES),
    );
  return html`<${Panel}
    title="Live"
    wide
    aside=${html`<${Choice}
      label="Live messages"
      value=${on}
      onChoose=${setOn}
      options=${[
        [false, "Off"],
        [true, "On"],
      ]}
    />`}
  >
    ${!on
      ? html`<p class="empty">
          Nothing is subscribed to. Switched on, <code>rmpa web</code> subscribes to it as a node of this module, once
          for all its clients.
        </p>`
      : html`<div class=${view || fields.length ? "live two" : "live"}>
          <div class="views">
            ${view === "image" && html`<${Image} connection=${connection} topic=${topic} />`}${view === "map" &&
            html`<${TopicMap} connection=${connection} state=${state} topic=${topic} type=${type} />`}
            ${fields.length > 0 &&
            html`<${Fields} key=${fields.join()} connection=${connection} topic=${topic} fields=${fields} />`}
          </div>
          <${Value} connection=${connection} topic=${topic} chosen=${fields} onChoose=${toggle} />
        </div>`}<//
  >`;
}

function useWatch(connection, wanted, take) {
  const [failure, setFailure] = useState(null);
  const sink = useRef(take);
  sink.current = take;
  useEffect(() => {
    setFailure(null);
    return connection.watch(wanted, (message) =>
      message.op === "failed" ? setFailure(message) : sink.current(message),
    );
  }, [JSON.stringify(wanted)]);
  return failure;
}

export function Value({ connection, topic, chosen, onChoose }) {
  const [message, set] = useState(null);
  const failure = useWatch(connection, { topic, how: "value", rate: 5 }, set);
  return html`<div>
    <${Failure} failure=${failure} />${message
      ? html`<p class="muted">
            ${clock(message.stamp)} · ${bytes(message.size)} · ${message.type}. Numbers can be chosen to be plotted.
          </p>
          <${MessageTree} value=${message.value} chosen=${chosen} onChoose=${onChoose} />`
      : !failure && html`<p class="empty">Waiting for a message …</p>`}
  </div>`;
}

export function Fields({ connection, topic, fields }) {
  const data = useRef([[], ...fields.map(() => [])]);
  const [version, grow] = useState(0);
  const failure = useWatch(connection, { topic, how: "plot", fields, rate: 10 }, (message) => {
    append(data.current, message.columns);
    grow((n) => n + 1);
  });
  const number = (value) => (value === null || value === undefined ? "–" : Number(value.toPrecision(5)).toString());
  return html`<div class="wide">
    <${Failure} failure=${failure} /><${Plot}
      labels=${fields}
      data=${data.current}
      version=${version}
      format=${number}
      label="Fields"
    />
  </div>`;
}

export function Image({ connection, topic }) {
  const canvas = useRef();
  const [about, set] = useState("");
  const busy = useRef(false);
  const show = async (message) => {
    if (busy.current || !canvas.current) return; // a picture that comes while one is decoded is left out
    busy.current = true;
    try {
      const view = canvas.current;
      if (message.format === "jpeg" || message.format === "png") {
        const picture = await createImageBitmap(new Blob([message.bytes], { type: `image/${message.format}` }));
        view.width = picture.width;
        view.height = picture.height;
        view.getContext("2d").drawImage(picture, 0, 0);
        picture.close();
      } else view.getContext("2d").putImageData(pixels(view, message), 0, 0);
      set(`${view.width} × ${view.height} · ${message.format} · ${clock(message.stamp)}`);
    } catch {
      set("The picture cannot be decoded.");
    } finally {
      busy.current = false;
    }
  };
  const failure = useWatch(connection, { topic, how: "image", rate: 10 }, show);
  return html`<figure class="wide">
    <${Failure} failure=${failure} /><canvas
      class="view"
      ref=${canvas}
      width="320"
      height="240"
      role="img"
      aria-label=${`Pictures of ${topic}`}
    ></canvas>
    <figcaption class="muted">${about || "Waiting for a picture …"}</figcaption>
  </figure>`;
}

function pixels(view, { width, height, format, bytes: raw }) {
  view.width = width;
  view.height = height;
  const made = new ImageData(width, height),
    out = made.data,
    channels = format === "rgb8" ? 3 : 1;
  for (let from = 0, to = 0; to < out.length; from += channels, to += 4) {
    out[to] = raw[from];
    out[to + 1] = raw[from + (channels > 1 ? 1 : 0)];
    out[to + 2] = raw[from + (channels > 1 ? 2 : 0)];
    out[to + 3] = 255;
  }
  return made;
}
