// The state that the server keeps up to date by JSON merge patches (RFC 7396).
// Objects have no prototype, so no name of a topic or module can mean anything to the language.

export function adopt(value) {
  if (Array.isArray(value)) return value.map(adopt);
  if (value === null || typeof value !== "object") return value;
  const made = Object.create(null);
  for (const key of Object.keys(value)) made[key] = adopt(value[key]);
  return made;
}

// Objects that a patch does not touch stay the same, so that only what changed is drawn again.
export function applyPatch(state, patch) {
  if (patch === null || typeof patch !== "object" || Array.isArray(patch)) return adopt(patch);
  const made = Object.create(null);
  if (state !== null && typeof state === "object" && !Array.isArray(state))
    for (const key of Object.keys(state)) made[key] = state[key];
  for (const key of Object.keys(patch)) {
    if (patch[key] === null) delete made[key];
    else made[key] = applyPatch(made[key], patch[key]);
  }
  return made;
}

const nothing = Object.freeze(Object.create(null));
export const section = (state, name) => (state && state[name]) || nothing;
export const entries = (state, name) => Object.entries(section(state, name));
