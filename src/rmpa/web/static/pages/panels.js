// Several things beside each other: messages, plots, pictures, a map, the log and more, in a grid that is kept by name.

import { html, useEffect, useRef, useState } from "../markup.js";
import { entries, section } from "../state.js";
import { AsPanel, Failure, IconButton, Page, Panel, Select, Text } from "../parts.js";
import { download, store, stored } from "../storage.js";
import { toggled } from "../plot.js";
import { Fields, IMAGES, Image, Value } from "../live.js";

const STORE = "rmpa.panels"; // in the browser: { current, layouts: { name: panels } }
const FORMAT = "rmpa-panels-1"; // of a file
const MOST = 12; // panels: a page may watch 16 topics
const MOST_LAYOUTS = 32;
const MOST_FIELDS = 8;
const LONGEST = 256; // characters of a name
const FILE_BYTES = 64 * 1024;
const WIDEST = 4,
  TALLEST = 3;
// What a panel shows: by its words, whether it has a topic and fields, or else the page that it is.
const KINDS = {
  message: ["Message", "topic"],
  plot: ["Plot", "topic", "fields"],
  picture: ["Picture", "topic"],
  map: ["Map"],
  log: ["Log"],
  diagnostics: ["Diagnostics"],
  drive: ["Drive"],
};
const ALONE = ["drive"]; // a page has one stick
const needs = (kind, what) => KINDS[kind].slice(1).includes(what);
const isText = (value) => typeof value === "string" && value.length > 0 && value.length <= LONGEST;
const span = (value, most) => (Number.isInteger(value) && value >= 1 && value <= most ? value : 1);

// Panels of a file or of the browser: { panels }, or { error }. What is not known of a panel is left out.
export function checked(list) {
  if (!Array.isArray(list)) return { error: "it has no list of panels" };
  if (list.length > MOST) return { error: `it has ${list.length} panels; ${MOST} are shown at most` };
  const panels = [];
  for (const [at, one] of list.entries()) {
    const kind = one?.kind;
    const wrong = (text) => ({ error: `panel ${at + 1} ${text}` });
    if (!Object.hasOwn(KINDS, kind)) return wrong(`is of no known kind: ${String(kind).slice(0, 40)}`);
    if (needs(kind, "topic") && !(isText(one.topic) && one.topic.startsWith("/"))) return wrong("has no topic");
    const fields = Array.isArray(one.fields) ? one.fields : [];
    if (needs(kind, "fields") && !(fields.length && fields.length <= MOST_FIELDS && fields.every(isText)))
      return wrong(`has no list of 1 to ${MOST_FIELDS} fields`);
    if (ALONE.includes(kind) && panels.some((each) => each.kind === kind)) return wrong(`is a second ${kind} panel`);
    const made = { kind, wide: span(one.wide, WIDEST), tall: span(one.tall, TALLEST) };
    if (needs(kind, "topic")) made.topic = one.topic;
    if (needs(kind, "fields")) made.fields = fields;
    if (kind === "map" && one.map && typeof one.map === "object") made.map = one.map;
    panels.push(made);
  }
  return { panels };
}

function restored() {
  const kept = stored(STORE);
  const layouts = Object.entries(kept.layouts || {})
    .slice(0, MOST_LAYOUTS)
    .map(([name, list]) => [name, checked(list).panels])
    .filter(([name, panels]) => isText(name) && panels);
  return { current: kept.current, layouts: layouts.length ? Object.fromEntries(layouts) : { Panels: [] } };
}

export function Panels({ state, connection, pages }) {
  const [kept, set] = useState(restored);
  const [arranging, arrange] = useState(null);
  const [failure, fail] = useState(null);
  const names = Object.keys(kept.layouts);
  const current = names.includes(kept.current) ? kept.current : names[0];
  const panels = kept.layouts[current];
  const open = arranging ?? panels.length === 0;
  const keep = (next) => {
    store(STORE, next);
    set(next);
    fail(null);
  };
  const change = (list, name = current) => keep({ current: name, layouts: { ...kept.layouts, [name]: list } });
  const replace = (at, news) => change(panels.map((one, each) => (each === at ? { ...one, ...news } : one)));
  const add = (panel) => {
    const next = checked([...panels, { tall: 1, wide: 1, ...panel }]);
    arrange(open); // it stays as it is, also after the first one
    return next.error ? fail({ error: `Not added: ${next.error}.` }) : change(next.panels);
  };
  // A number that is chosen in a message is a line of the topic's plot.
  const plot = (topic, path) => {
    const at = panels.findIndex((one) => one.kind === "plot" && one.topic === topic);
    if (at < 0) return add({ kind: "plot", topic, fields: [path], wide: 2 });
    const fields = toggled(panels[at].fields, path);
    return fields.length ? replace(at, { fields }) : change(panels.filter((_, each) => each !== at));
  };
  const plotted = (topic) =>
    panels.filter((one) => one.kind === "plot" && one.topic === topic).flatMap((one) => one.fields);
  return html`<${Page}
    title="Panels"
    kind=${`${current}: kept in this browser`}
    aside=${html`<button type="button" aria-pressed=${String(open)} onClick=${() => arrange(!open)}>Arrange</button>`}
  >
    <${Failure} failure=${failure} />
    ${open &&
    html`<${Panel}
      ><${Layouts} ...${{ kept, keep, current, panels, change, fail }} />
      <${Add} ...${{ state, pages, panels, add, may: connection.hello.may }}
    /><//>`}
    <div class="panels">
      ${panels.map(
        (one, at) =>
          html`<section
            key=${keyOf(panels, at)}
            class=${`panel slot w${one.wide} h${one.tall}`}
            aria-label=${titleOf(one)}
          >
            <header>
              <h2>${titleOf(one)}</h2>
              ${open && html`<${Controls} ...${{ one, at, panels, change, replace }} />`}
            </header>
            <div class="content" tabindex="0" role="group" aria-label=${`${titleOf(one)}, content`}>
              <${Content}
                ...${{ one, state, connection, pages, plot, plotted: plotted(one.topic) }}
                keep=${(map) => replace(at, { map })}
              />
            </div>
          </section>`,
      )}
    </div>
    ${!panels.length && html`<p class="empty">Add what is to be shown beside each other.</p>`}<//
  >`;
}

// A panel that is moved stays the same.
const keyOf = (panels, at) => {
  const same = (one) => one.kind === panels[at].kind && one.topic === panels[at].topic;
  return `${panels[at].kind} ${panels[at].topic} ${panels.slice(0, at).filter(same).length}`;
};
const titleOf = ({ kind, topic }) => (topic ? `${KINDS[kind][0]} ${topic}` : KINDS[kind][0]);

function Content({ one, state, connection, pages, plot, plotted, keep }) {
  const { kind, topic } = one;
  if (kind === "message")
    return html`<${Value} ...${{ connection, topic }} chosen=${plotted} onChoose=${(path) => plot(topic, path)} />`;
  if (kind === "plot")
    return html`<${Fields} key=${one.fields.join()} ...${{ connection, topic, fields: one.fields }} />`;
  if (kind === "picture")
    return html`<${Image} ...${{ connection, topic, state }} type=${section(state, "topics")[topic]?.type} />`;
  const more = kind === "map" ? { kept: one.map ?? {}, keep: (news) => keep({ ...one.map, ...news }) } : {};
  return html`<${AsPanel.Provider} value=${true}
    ><${Loaded} ...${{ page: pages[kind], state, connection, pages, ...more }}
  /><//>`;
}

// A page, loaded when it is first shown.
function Loaded({ page, ...props }) {
  const [module, set] = useState(null);
  useEffect(() => {
    if (page) import(`./${page[0]}`).then(set, () => set({ failed: true }));
  }, []);
  if (!page || module?.failed) return html`<p class="empty">This page cannot be loaded.</p>`;
  return module ? html`<${module[page[1]]} ...${props} />` : html`<p class="empty">Loading …</p>`;
}

function Controls({ one, at, panels, change, replace }) {
  const swap = (to) => {
    const list = [...panels];
    [list[at], list[to]] = [list[to], list[at]];
    change(list);
  };
  const controls = [
    ["Earlier", "↑", at === 0, () => swap(at - 1)],
    ["Later", "↓", at === panels.length - 1, () => swap(at + 1)],
    ["Wider", "↔", one.wide >= WIDEST, () => replace(at, { wide: one.wide + 1 })],
    ["Narrower", "→←", one.wide <= 1, () => replace(at, { wide: one.wide - 1 })],
    ["Taller", "↕", one.tall >= TALLEST, () => replace(at, { tall: one.tall + 1 })],
    ["Shorter", "⇕", one.tall <= 1, () => replace(at, { tall: one.tall - 1 })],
    ["Remove", "×", false, () => change(panels.filter((_, each) => each !== at))],
  ];
  return html`<div class="tools">
    ${controls.map(
      ([label, sign, disabled, press]) =>
        html`<${IconButton} key=${label} label=${`${label}: ${titleOf(one)}`} title=${label} ...${{ disabled, press }}
          >${sign}<//
        >`,
    )}
  </div>`;
}

function Layouts({ kept, keep, current, panels, change, fail }) {
  const [name, setName] = useState("");
  const file = useRef();
  const names = Object.keys(kept.layouts);
  const save = (event) => {
    event.preventDefault();
    const wanted = name.trim();
    if (!isText(wanted)) return fail({ error: "Type a name for these panels." });
    if (!names.includes(wanted) && names.length >= MOST_LAYOUTS)
      return fail({ error: `${MOST_LAYOUTS} layouts are kept: remove one first.` });
    setName("");
    return change(panels, wanted);
  };
  const remove = () => {
    const left = Object.entries(kept.layouts).filter(([each]) => each !== current);
    keep({ current: "", layouts: left.length ? Object.fromEntries(left) : { Panels: [] } });
  };
  const write = () => {
    const text = JSON.stringify({ format: FORMAT, name: current, panels }, null, 2);
    download(`${current.replace(/[^\w-]+/g, "_")}.json`, "application/json", text);
  };
  const read = async () => {
    const [chosen] = file.current.files;
    file.current.value = "";
    if (!chosen) return;
    const refuse = (text) => fail({ error: `${chosen.name} is not imported: ${text}.` });
    if (chosen.size > FILE_BYTES) return refuse(`it is larger than ${FILE_BYTES / 1024} kB`);
    let made;
    try {
      made = JSON.parse(await chosen.text());
    } catch {
      return refuse("it is not JSON");
    }
    if (made?.format !== FORMAT) return refuse(`its format is not ${FORMAT}`);
    const next = checked(made.panels);
    if (next.error) return refuse(next.error);
    if (!names.includes(made.name) && names.length >= MOST_LAYOUTS) return refuse(`${MOST_LAYOUTS} layouts are kept`);
    change(next.panels, isText(made.name) ? made.name : chosen.name.slice(0, LONGEST));
  };
  return html`<form class="row" onSubmit=${save}>
    <${Select} label="Layout" value=${current} names=${names} onChange=${(each) => keep({ ...kept, current: each })} />
    <${Text} label="New name" value=${name} onInput=${setName} />
    <button>Save as</button>
    <button type="button" onClick=${remove}>Remove layout</button>
    <button type="button" onClick=${write}>Export</button>
    <button type="button" onClick=${() => file.current.click()}>Import</button>
    <input type="file" accept="application/json" hidden ref=${file} aria-label="File of panels" onChange=${read} />
  </form>`;
}

function Add({ state, pages, panels, add, may }) {
  const [kind, setKind] = useState("message");
  const [topic, setTopic] = useState("");
  const [fields, setFields] = useState("");
  const kinds = Object.keys(KINDS).filter(
    (each) => needs(each, "topic") || (each in pages && (each !== "drive" || may.includes("drive"))),
  );
  const topics = entries(state, "topics").filter(([, one]) => kind !== "picture" || IMAGES.includes(one.type));
  const submit = (event) => {
    event.preventDefault();
    const large = kind === "map" || kind === "drive" ? { wide: 2, tall: 2 } : { wide: kind === "message" ? 1 : 2 };
    const lines = fields.split(",").map((each) => each.trim());
    add({ kind, topic: topic.trim(), fields: lines.filter(Boolean), ...large });
  };
  return html`<form class="row" onSubmit=${submit}>
    <${Select} label="Panel" value=${kind} names=${kinds.map((each) => [each, KINDS[each][0]])} onChange=${setKind} />
    ${needs(kind, "topic") &&
    html`<${Text} label="Topic" class="mono" list="topics" value=${topic} onInput=${setTopic} />
      <datalist id="topics">${topics.map(([each]) => html`<option key=${each} value=${each} />`)}</datalist>`}
    ${needs(kind, "fields") &&
    html`<${Text}
      label="Fields"
      class="mono"
      placeholder="pose.pose.position.x, twist.twist.linear.x"
      value=${fields}
      onInput=${setFields}
    />`}
    <button class="primary" disabled=${panels.length >= MOST}>Add</button>
  </form>`;
}
