// Figures as text: always the same width of digits, always a unit.

const THIN = "\u2009";
const digits = (value) =>
  Math.abs(value) >= 99.95 ? value.toFixed(0) : Math.abs(value) >= 9.995 ? value.toFixed(1) : value.toFixed(2);

function scaled(value, unit, prefixes) {
  let at = 0;
  while (Math.abs(value) >= 999.5 && at < prefixes.length - 1) {
    value /= 1000;
    at += 1;
  }
  return `${at || !Number.isInteger(value) ? digits(value) : value}${THIN}${prefixes[at]}${unit}`;
}

export const NONE = "–";
const known = (value) => value !== undefined && value !== null && Number.isFinite(value);
export const bytes = (value) => (known(value) ? scaled(value, "B", ["", "k", "M", "G", "T"]) : NONE);
export const bandwidth = (value) => (known(value) ? `${scaled(value, "B", ["", "k", "M", "G"])}/s` : NONE);
export function hertz(value) {
  if (!known(value)) return NONE;
  if (value >= 99.95) return `${value.toFixed(0)}${THIN}Hz`;
  return `${value >= 9.95 ? value.toFixed(1).replace(/\.0$/, "") : Number(value.toPrecision(2))}${THIN}Hz`;
}
export const count = (value) => (known(value) ? value.toLocaleString("en") : NONE);
export const percent = (value) => (known(value) ? `${value < 10 ? value.toFixed(1) : value.toFixed(0)}${THIN}%` : NONE);

export function seconds(value) {
  if (!known(value)) return NONE;
  const size = Math.abs(value);
  if (size === 0) return `0${THIN}s`;
  if (size < 0.9995e-3) return `${digits(value * 1e6)}${THIN}µs`;
  if (size < 0.9995) return `${digits(value * 1e3)}${THIN}ms`;
  return size < 99.95 ? `${digits(value)}${THIN}s` : duration(value);
}

export function duration(value) {
  if (!known(value)) return NONE;
  value = Math.max(0, Math.round(value));
  if (value < 60) return `${value}${THIN}s`;
  if (value < 3600) return `${Math.floor(value / 60)}${THIN}min ${String(value % 60).padStart(2, "0")}${THIN}s`;
  if (value < 86400)
    return `${Math.floor(value / 3600)}${THIN}h ${String(Math.floor((value % 3600) / 60)).padStart(2, "0")}${THIN}min`;
  return `${Math.floor(value / 86400)}${THIN}d ${Math.floor((value % 86400) / 3600)}${THIN}h`;
}

export const ago = (moment) => (known(moment) ? duration(Date.now() / 1000 - moment) : NONE);
export function clock(moment) {
  const at = new Date(moment * 1000),
    time = at.toLocaleTimeString("en-GB");
  return at.toDateString() === new Date().toDateString()
    ? time
    : `${at.toLocaleDateString("en-GB", { day: "numeric", month: "short" })} ${time}`;
}
export const bounded = (value, error) => (known(value) ? `${seconds(value)} ± ${seconds(error)}` : NONE);

// A text as it can be read: characters that are not seen, or that turn the reading direction, by their codes.
const UNSEEN = new RegExp(
  "[\\0-\\x08\\v\\f\\x0e-\\x1f\\x7f-\\x9f\\xad\\u061c\\u180e\\u200b-\\u200f\\u2028-\\u202e" +
    "\\u2060-\\u206f\\ufeff\\ufff9-\\ufffb\\u{e0000}-\\u{e007f}]",
  "gu",
);
const code = (character) => {
  const hex = character.codePointAt(0).toString(16);
  return hex.length > 4 ? `\\u{${hex}}` : `\\u${hex.padStart(4, "0")}`;
};
export const plain = (text) => text.replace(UNSEEN, code);

// A text as a sentence, to stand beside others.
export function sentence(text) {
  const said = (text || "").trim();
  if (!said) return "";
  const begun = /^[a-z]+ /.test(said) && !said.startsWith("rmpa ") ? said[0].toUpperCase() + said.slice(1) : said;
  return /[.!?…]$/.test(begun) ? begun : `${begun}.`;
}
