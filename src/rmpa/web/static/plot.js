// Plots by uPlot, which is loaded when the first one is shown. Without it, and for those who read by ear, there are the
// newest figures as text.

import { html, useEffect, useRef, useState } from "./markup.js";
import { ink, onTheme } from "./theme.js";

const LINES = 8; // of a plot
const KEPT = 600; // samples of each line
const DASHES = [[], [7, 4], [2, 3], [10, 3, 2, 3]];

let loading;
function library() {
  loading ||= new Promise((resolve, reject) => {
    const style = document.createElement("link");
    style.rel = "stylesheet";
    style.href = new URL("vendor/uPlot.css", import.meta.url);
    const script = document.createElement("script");
    script.src = new URL("vendor/uPlot.js", import.meta.url);
    script.onload = () => resolve(window.uPlot);
    script.onerror = () => {
      loading = undefined;
      reject(new Error("uPlot cannot be loaded"));
    };
    document.head.append(style, script);
  });
  return loading;
}

const COLOURS = ["--accent", "--good", "--warn", "--bad", "--idle", "--text"];

const time = (value) => new Date(value * 1000).toLocaleTimeString("en-GB");

function options(labels, format, width, zero) {
  const axis = {
    stroke: ink("--muted"),
    grid: { stroke: ink("--line"), width: 1 },
    ticks: { stroke: ink("--line"), width: 1 },
    font: "12px system-ui",
  };
  return {
    width,
    height: 240,
    legend: { live: true },
    scales: zero ? { y: { range: (_, low, high) => [Math.min(0, low ?? 0), Math.max((high ?? 0) * 1.15, 1e-6)] } } : {},
    axes: [
      { ...axis, space: 90, incrs: [1, 2, 5, 10, 30, 60, 120, 300], values: (_, values) => values.map(time) },
      { ...axis, size: 76, values: (_, values) => values.map((value) => format(value)) },
    ],
    series: [
      { value: (_, value) => (value ? time(value) : "–") },
      ...labels.map((label, at) => ({
        label,
        stroke: ink(COLOURS[at % COLOURS.length]),
        width: 1.6,
        dash: DASHES[Math.floor(at / COLOURS.length) % DASHES.length],
        points: { show: false },
        value: (_, value) => (value === null || value === undefined ? "–" : format(value)),
      })),
    ],
  };
}

export const figure = (value) => (value === null || value === undefined ? "–" : String(Number(value.toPrecision(5))));
// The lines of a plot with another one, or without one that was there.
export const toggled = (lines, one) =>
  lines.includes(one) ? lines.filter((each) => each !== one) : [...lines, one].slice(-LINES);

// `data` is a list of columns that grows in place; `version` says when it did. `zero`: whether the scale begins at 0.
export function Plot({ labels, data, version, format, label, zero }) {
  const box = useRef(),
    plot = useRef();
  const [failure, setFailure] = useState("");
  useEffect(() => {
    let ended = false,
      observer,
      themes;
    library().then(
      (uPlot) => {
        if (ended) return;
        const make = () => {
          plot.current?.destroy();
          plot.current = new uPlot(options(labels, format, box.current.clientWidth, zero), data, box.current);
        };
        make();
        observer = new ResizeObserver(() => plot.current.setSize({ width: box.current.clientWidth, height: 240 }));
        observer.observe(box.current);
        themes = onTheme(make);
      },
      (error) => setFailure(String(error.message)),
    );
    return () => {
      ended = true;
      observer?.disconnect();
      themes?.();
      plot.current?.destroy();
      plot.current = undefined;
    };
  }, [labels.join("\n")]);
  useEffect(() => {
    if (!plot.current) return;
    plot.current.setData(data);
    const pointed = plot.current.cursor.left >= 0;
    if (!pointed) plot.current.setLegend({ idx: data[0].length - 1 }); // the newest
  }, [version]);
  const newest = labels.map((name, at) => `${name} ${format(data[at + 1]?.[data[at + 1].length - 1])}`).join(", ");
  return html`<div>
    <div class="plot" ref=${box} role="img" aria-label=${`${label}: ${newest}`}></div>
    ${failure && html`<p class="empty">${failure}. ${newest}</p>`}
  </div>`;
}

export function append(data, columns) {
  columns.forEach((column, at) => {
    const line = (data[at] ||= []);
    line.push(...column);
    if (line.length > KEPT) line.splice(0, line.length - KEPT);
  });
}

// A plot of figures that the page draws with its state: one sample each half second.
export function Lines({ series, format, label }) {
  const latest = useRef(series);
  latest.current = series;
  const labels = series.map((each) => each.label);
  const data = useRef([]);
  const [version, grow] = useState(0);
  useEffect(() => {
    data.current = [[], ...labels.map(() => [])];
    const take = () => {
      append(data.current, [
        [Date.now() / 1000],
        ...latest.current.map((each) => [Number.isFinite(each.value) ? each.value : null]),
      ]);
      grow((n) => n + 1);
    };
    take();
    const timer = setInterval(take, 500);
    return () => clearInterval(timer);
  }, [labels.join("\n")]);
  if (data.current.length !== labels.length + 1) data.current = [[], ...labels.map(() => [])];
  return html`<${Plot} ...${{ labels, version, format, label }} data=${data.current} zero=${true} />`;
}
