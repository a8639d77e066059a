// Elements of the page. Text of files and maps becomes text, never markup.

export function el(name, settings = {}, ...content) {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(settings)) {
    if (value === undefined || value === null || value === false) continue;
    if (key === "class") element.className = value;
    else if (key === "data") Object.assign(element.dataset, value);
    else if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (key in element && key !== "list") element[key] = value;
    else element.setAttribute(key, value === true ? "" : value);
  }
  element.append(...content.flat(Infinity).filter((part) => part !== null && part !== undefined && part !== false));
  return element;
}

export function button(words, onclick, settings = {}) {
  return el("button", { type: "button", onclick, ...settings }, words);
}

// Shows `fresh` in `place`. What is there and equal stays: a click that is under way on it would be lost with it.
export function showAll(place, fresh) {
  const old = [...place.children], kept = new Set();
  for (const node of fresh) {
    const same = old.find((one) => !kept.has(one) && one.isEqualNode(node));
    const boxes = same ? [...same.querySelectorAll("input[type=checkbox]")] : [];
    node.querySelectorAll("input[type=checkbox]").forEach((box, k) => { if (boxes[k]) boxes[k].checked = box.checked; });
    kept.add(same ?? node);
  }
  for (const one of old) if (!kept.has(one)) one.remove();
  let next = place.firstElementChild;
  for (const node of kept) {
    if (node === next) next = next.nextElementSibling;
    else place.insertBefore(node, next);
  }
}

export function toast(words, kind = "") {
  const note = el("div", { class: `toast ${kind}` }, words);
  document.getElementById("toasts").append(note);
  setTimeout(() => note.remove(), kind === "bad" ? 9000 : 4000);
}

export function formatBytes(bytes) {
  const units = ["B", "kB", "MB", "GB"];
  let k = 0, value = bytes;
  while (value >= 1000 && k < 3) [value, k] = [value / 1000, k + 1];
  return `${k && value < 10 ? value.toFixed(1) : Math.round(value)} ${units[k]}`;
}

export const formatPercent = (share) => (share > 0.995 && share < 1 ? "over 99 %" : `${Math.round(100 * share)} %`);

// Asks in a dialog; resolves with what was entered, or null.
export function ask(title, fields) {
  return new Promise((done) => {
    const inputs = fields.map(({ label, options, ...settings }) => {
      const input = options
        ? el("select", settings, options.map((one) => el("option", { value: one, selected: one === settings.value }, one || "–")))
        : el("input", { type: "text", autocomplete: "off", ...settings });
      return [input, el("label", {}, el("span", {}, label), input)];
    });
    const dialog = el("dialog", { class: "ask" });
    let given = null;
    const form = el("form", { method: "dialog" }, el("h2", {}, title), inputs.map(([, label]) => label),
      el("div", { class: "row end" }, button("Cancel", () => dialog.close()), el("button", { type: "submit", class: "primary" }, "OK")));
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      given = inputs.map(([input]) => (input.type === "checkbox" ? input.checked : input.value.trim()));
      dialog.close();
    });
    dialog.addEventListener("close", () => { dialog.remove(); done(given); });
    dialog.append(form);
    document.body.append(dialog);
    dialog.showModal();
    inputs[0][0].focus();
    inputs[0][0].select?.();
  });
}
