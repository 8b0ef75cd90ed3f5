// A file that describes a resource of this module: edited, checked by the server, and saved.

import { html, useEffect, useRef, useState } from "../markup.js";
import { Failure, Mark, Page, Panel } from "../parts.js";

// What is typed and not saved, by file, with the digest of the text that it changes: it stays while the page is open.
const drafts = new Map();

// What the key at a place of a text means, by the last heading above it; the server has it of the schema.
export function meaning(text, at, help) {
  const lines = text.slice(0, at).split("\n");
  const line = lines.at(-1) + text.slice(at).split("\n")[0];
  const heading = (each) => /^\s*\[\s*([\w-]+)/.exec(each)?.[1];
  const table = [...lines.slice(0, -1), line].map(heading).findLast(Boolean);
  const key = /^\s*([\w-]+)\s*=/.exec(line)?.[1];
  const name = !key ? heading(line) : table ? `${table}.${key}` : key;
  return name && help[name] ? { name, text: help[name] } : null;
}

export function DescriptionPage({ name, connection }) {
  const body = connection.may("control")
    ? html`<${Editor} ...${{ name, connection }} />`
    : html`<p class="empty">
        This page may only look. A page with the right to control (<code>rmpa web --control</code>) reads and changes
        it.
      </p>`;
  return html`<${Page} title=${name} kind="Describes a resource of this module"><${Panel}>${body}<//><//>`;
}

function Editor({ name, connection }) {
  const [file, setFile] = useState(null); // as it was read: text, digest, help
  const [text, setText] = useState("");
  const [state, set] = useState({ problems: [] });
  const [at, setAt] = useState(0);
  const area = useRef(),
    gutter = useRef();
  const read = () =>
    connection.ask("description", { file: name }).then(
      (found) => {
        setFile({ ...found, ...drafts.get(name) });
        setText(drafts.get(name)?.typed ?? found.text);
        set({ problems: [] });
      },
      (failure) => set({ failure, problems: [] }),
    );
  useEffect(() => void read(), []);
  const edit = (typed) => {
    drafts.set(name, { typed, digest: file.digest });
    setText(typed);
    set((before) => ({ problems: before.problems }));
  };
  const order = (what, args, done) => {
    set(({ problems, saved }) => ({ problems, saved, waits: true }));
    return connection.ask(what, args).then(done, (failure) => set(({ saved }) => ({ failure, saved, problems: [] })));
  };
  const check = () =>
    order("check_description", { file: name, text }, ({ problems }) =>
      set({ problems, said: !problems.length && "Nothing is wrong with it." }),
    );
  const save = () =>
    order("save_description", { file: name, text, digest: file.digest }, ({ problems, digest, backup }) => {
      if (problems.length) return set({ problems });
      drafts.delete(name);
      setFile({ ...file, text, digest });
      return set({ problems, saved: true, said: `Saved. The text before is in ${backup}.` });
    });
  const resource = name.replace(/\.resource\.toml$/, "");
  const restart = () =>
    order("launch", { do: "restart", name: resource }, () =>
      set({ problems: [], saved: true, said: `${resource} starts again.` }),
    );
  const revert = () => {
    drafts.delete(name);
    read();
  };
  const lines = text.split("\n");
  const show = (line) => {
    const from = lines.slice(0, line - 1).reduce((sum, each) => sum + each.length + 1, 0);
    area.current.focus();
    area.current.setSelectionRange(from, from + (lines[line - 1] || "").length);
  };
  if (!file)
    return html`<${Failure} failure=${state.failure} />${!state.failure && html`<p class="empty">Reading …</p>`}`;
  const wrong = new Set(state.problems.map((each) => each.line));
  const about = meaning(text, at, file.help);
  const place = (event) => setAt(event.target.selectionStart);
  const changed = text !== file.text;
  return html`<div class="editor">
      <div ref=${gutter} class="gutter" aria-hidden="true">
        ${lines.map((_, row) => html`<div key=${row} class=${wrong.has(row + 1) ? "wrong" : ""}>${row + 1}</div>`)}
      </div>
      <textarea
        ref=${area}
        aria-label=${`Text of ${name}`}
        aria-invalid=${String(wrong.size > 0)}
        wrap="off"
        spellcheck=${false}
        autocapitalize="off"
        value=${text}
        onInput=${(event) => (edit(event.target.value), place(event))}
        onKeyUp=${place}
        onClick=${place}
        onScroll=${() => (gutter.current.scrollTop = area.current.scrollTop)}
      ></textarea>
    </div>
    <p class="muted hint">
      ${about ? html`<code>${about.name}</code> ${about.text}` : "The key at the cursor is explained here."}
    </p>
    ${state.problems.map(
      (each, number) =>
        html`<p class="failure" role="alert" key=${number}>
          <${Mark} state="ERROR" word="" /><button type="button" class="field sort" onClick=${() => show(each.line)}>
            line ${each.line}</button
          >: ${each.problem}${each.remedy && html`<br /><span class="muted">${each.remedy}</span>`}
        </p>`,
    )}
    <${Failure} failure=${state.failure} />
    <div class="row">
      <button type="button" class="primary" disabled=${state.waits || !changed} onClick=${save}>Save</button>
      <button type="button" disabled=${state.waits} onClick=${check}>Check</button>
      <button type="button" disabled=${state.waits} onClick=${revert}>Load again</button>
      ${state.saved && html`<button type="button" onClick=${restart}>Restart ${resource}</button>`}
      <span role="status" class="muted"
        >${state.waits ? "Checking …" : state.said || (changed && "Not saved yet.")}</span
      >
    </div>`;
}
