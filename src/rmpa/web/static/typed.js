// What a user has typed, as the value that is meant: `{ value }`, or `{ error }` and then nothing is sent.

const NUMBER = /^[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$/i;
const TRUTHS = { true: true, false: false };

export function number(text, whole = false) {
  const typed = text.trim();
  if (!typed) return { error: "Type a number." };
  if (!NUMBER.test(typed)) {
    const point = typed.replace(",", ".");
    return { error: `${JSON.stringify(typed)} is not a number${NUMBER.test(point) ? `: write it as ${point}` : ""}.` };
  }
  const value = Number(typed);
  if (whole && !Number.isInteger(value)) return { error: `${typed} is not a whole number.` };
  if (!Number.isFinite(value) || (Number.isInteger(value) && !Number.isSafeInteger(value)))
    return { error: `${typed} is beyond what a browser counts exactly.` };
  return { value };
}

export function truth(text) {
  const value = TRUTHS[text.trim().toLowerCase()];
  return value === undefined ? { error: `${JSON.stringify(text.trim())} is neither true nor false.` } : { value };
}

// JSON whose whole numbers a browser has as they were typed: beyond 2^53 they would be sent as others.
export function json(text) {
  let beyond = false;
  const keep = (_, value) => {
    beyond ||= Number.isInteger(value) && !Number.isSafeInteger(value);
    return value;
  };
  try {
    const value = JSON.parse(text, keep);
    return beyond ? { error: "It has a number that is too large for a browser." } : { value };
  } catch (error) {
    return { error: `That is not JSON: ${error.message}` };
  }
}

// The value of a Smart Resource's parameter: of its type, one of its choices, within its bounds.
export function setting(text, about) {
  const typed =
    about.type === "str" ? { value: text } : about.type === "bool" ? truth(text) : number(text, about.type === "int");
  if (typed.error) return typed;
  const { value } = typed,
    { low, high, choices } = about;
  if (choices?.length && !choices.includes(value)) return { error: `${text} is none of ${choices.join(", ")}.` };
  if ((typeof low === "number" && value < low) || (typeof high === "number" && value > high))
    return { error: `${text.trim()} is not within ${low ?? "−∞"} … ${high ?? "∞"}.` };
  return typed;
}

// Another value for a parameter of the core: of the kind that it has.
export function another(text, before) {
  if (typeof before === "number") return number(text);
  if (typeof before === "boolean") return truth(text);
  const typed = json(text);
  if (typeof before === "string") return { value: typeof typed.value === "string" ? typed.value : text };
  if (typed.error || Array.isArray(typed.value)) return typed;
  return { error: "It is a list: write [ … ]." };
}

// The value of a new parameter: JSON where it is some, else the text itself.
export function fresh(text) {
  if (!text.trim()) return { error: 'Type a value; an empty text is "".' };
  const typed = json(text);
  if (typed.value === null) return { error: "A parameter cannot be null." };
  return typed.error?.startsWith("That is not JSON") ? { value: text } : typed;
}

const BITS = { byte: 8, char: 8 };
for (const bits of [8, 16, 32, 64]) BITS[`int${bits}`] = BITS[`uint${bits}`] = bits;
const BEYOND = /^[+-]?(nan|inf(inity)?)$/i;
const NANO = 1e9;

// A primitive of a ROS message, as JSON has it: what JSON has no number for goes as text.
export function primitive(type, text) {
  const typed = text.trim();
  if (type === "string") return { value: text };
  if (type === "bool") return truth(text);
  if (type === "time" && typed === "now") return { value: "now" };
  if (type === "time" || type === "duration") {
    const { value, error } = number(typed);
    if (error) return { error: type === "time" ? "Type now, or seconds since 1970." : "Type seconds." };
    const secs = Math.floor(value);
    if (type === "time" ? secs < 0 || secs >= 2 ** 32 : Math.abs(value) >= 2 ** 31)
      return { error: `${typed} s do not fit a ${type}.` };
    return { value: { secs, nsecs: Math.min(NANO - 1, Math.round((value - secs) * NANO)) } };
  }
  if (type.startsWith("float")) {
    const short = typed.toLowerCase().replace("infinity", "inf");
    if (BEYOND.test(typed)) return { value: short.replace(/^[+-]nan$/, "nan") };
    if (!NUMBER.test(typed)) return number(typed);
    if (Math.abs(Number(typed)) > (type === "float32" ? 3.4028235677973366e38 : Number.MAX_VALUE))
      return { error: `${typed} does not fit ${type}.` };
    return { value: Number(typed) };
  }
  if (!/^[+-]?\d{1,20}$/.test(typed))
    return number(typed, true).error ? number(typed, true) : { error: "Write all its digits." };
  const value = BigInt(typed),
    size = 2n ** BigInt(BITS[type] - (/^u|char/.test(type) ? 0 : 1));
  const low = /^u|char/.test(type) ? 0n : -size;
  if (value < low || value >= size) return { error: `${typed} is not within ${low} … ${size - 1n} (${type}).` };
  return { value: BITS[type] === 64 ? String(value) : Number(value) };
}

export const kind = (value) =>
  Array.isArray(value) ? "list" : { string: "text", object: "namespace" }[typeof value] || typeof value;
