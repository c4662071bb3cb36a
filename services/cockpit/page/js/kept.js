// What this browser remembers of the person's choices. Without storage (a private window) nothing is remembered.
export function kept(name) {
  try {
    return localStorage.getItem(`cocoro.${name}`);
  } catch {
    return null;
  }
}

export function keep(name, value) {
  try {
    localStorage.setItem(`cocoro.${name}`, value);
  } catch {
    // the choice holds for this page alone
  }
}
