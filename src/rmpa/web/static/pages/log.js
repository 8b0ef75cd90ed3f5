// The log of all nodes, /rosout, newest first.

import { html, useEffect, useState } from "../vendor/htm-preact.js";
import { clock } from "../format.js";
import { Choice, Mark, Page, Panel } from "../parts.js";

const KEPT = 500;
const LEVELS = [["DEBUG", "All"], ["INFO", "Info"], ["WARN", "Warnings"], ["ERROR", "Errors"]];
const RANK = { DEBUG: 0, INFO: 1, WARN: 2, ERROR: 3, FATAL: 4 };
const MARKS = { DEBUG: "", INFO: "OK", WARN: "WARN", ERROR: "ERROR", FATAL: "ERROR" };

const keyOf = (line) => `${line.n} ${line.at}`;

export function Log({ connection }) {
  const [lines, setLines] = useState([]);
  const [level, setLevel] = useState("INFO");
  const [text, setText] = useState("");
  const [held, hold] = useState(false);
  useEffect(() => held ? undefined : connection.followLog((more) => setLines((before) => {
    const seen = new Set(before.map(keyOf)); // the server sends what it has kept at each new connection
    return [...more.filter((line) => !seen.has(keyOf(line))).reverse(), ...before].slice(0, KEPT);
  })), [held]);
  const shown = lines.filter((line) => RANK[line.level] >= RANK[level] && `${line.node} ${line.text}`.toLowerCase().includes(text.toLowerCase()));
  return html`<${Page} title="Log" kind="/rosout of this module, newest first" aside=${html`<button type="button" aria-pressed=${String(held)} onClick=${() => hold(!held)}>${held ? "Go on" : "Hold"}</button>`}>
    <div class="row"><label>Level<${Choice} label="Least level" value=${level} onChoose=${setLevel} options=${LEVELS} /></label><label>Text or node<input type="search" value=${text} onInput=${(event) => setText(event.target.value)} /></label></div><br />
    <${Panel}>${shown.length ? html`<div role="log" aria-label="Log">${shown.map((line) => html`<div class="logline" key=${keyOf(line)}><time class="muted mono">${clock(line.at)}</time><${Mark} state=${MARKS[line.level]} word=${line.level} /><span class="mono muted">${line.node}</span><span>${line.text}</span></div>`)}</div>` : html`<p class="empty">No line yet.</p>`}<//><//>`;
}
