// What the page asks the server for.

export class Refused extends Error {
  constructor(status, words, version) {
    super(words);
    Object.assign(this, { status, version });
  }
}

export const encodePath = (path) => path.split("/").map(encodeURIComponent).join("/");

async function request(method, path, body) {
  const answer = await fetch(path, { method, body: body === undefined ? undefined : JSON.stringify(body) });
  if (answer.ok) return answer.json();
  const told = await answer.json().catch(() => ({ error: `the server answered ${answer.status}` }));
  throw new Refused(answer.status, told.error, told.version);
}

export const get = (path) => request("GET", path);
export const post = (path, body) => request("POST", path, body);
export const remove = (path) => request("DELETE", path);

export function send(file, progress) { // fetch does not tell how far an upload is
  return new Promise((done, failed) => {
    const wire = new XMLHttpRequest();
    wire.open("PUT", `/api/files/${encodeURIComponent(file.name)}`);
    wire.upload.addEventListener("progress", (event) => progress(event.loaded / Math.max(event.total, 1)));
    wire.addEventListener("load", () => {
      let told = {};
      try { told = JSON.parse(wire.responseText); } catch { /* no words */ }
      if (wire.status === 201) done(told);
      else failed(new Refused(wire.status, told.error || `the server answered ${wire.status}`));
    });
    wire.addEventListener("error", () => failed(new Refused(0, `${file.name}: could not be sent`)));
    wire.addEventListener("abort", () => failed(new Refused(0, `${file.name}: cancelled`)));
    progress(0, () => wire.abort());
    wire.send(file);
  });
}

// Events of the server, as events of the document: "studio:folder", "studio:job", "studio:map", "studio:merge".
export function listen(state) {
  const source = new EventSource("/api/events");
  let lost = false;
  source.addEventListener("open", () => {
    state(true);
    if (lost) document.dispatchEvent(new CustomEvent("studio:back"));
    lost = false;
  });
  source.addEventListener("error", () => { lost = true; state(false); });
  source.addEventListener("message", (event) => {
    const told = JSON.parse(event.data);
    document.dispatchEvent(new CustomEvent(`studio:${told.kind}`, { detail: told }));
  });
}
