// The view of the folder: what lies in it, files that are dropped, and the jobs.

import { encodePath, get, post, remove, send } from "./api.js";
import { button, el, formatBytes, formatPercent, showAll, toast } from "./dom.js";

const STATES = { waiting: "waits", running: "runs", done: "done", failed: "failed", cancelled: "cancelled" };
const KINDS = { extract: "Extract", merge: "Merge", compare: "Compare" };

export class FolderView {
  constructor(place) {
    Object.assign(this, { place, chosen: new Set(), jobs: new Map(), entries: [], uploads: new Map() });
    this.list = el("div", { class: "lists" });
    this.actions = el("div", { class: "actions", hidden: true });
    this.rows = el("ul");
    this.work = el("div", { class: "jobs", hidden: true }, el("h2", {}, "Work"), this.rows);
    this.input = el("input", { type: "file", multiple: true, hidden: true, onchange: () => { this.sendAll([...this.input.files]); this.input.value = ""; } });
    this.drop = el("button", { type: "button", class: "drop", onclick: () => this.input.click() }, el("b", {}, "Add scans, plans or maps"), el("span", {}, "Drop files here, or click to choose them."));
    place.replaceChildren(el("div", { class: "folder" }, el("div", { class: "main" }, this.actions, this.list), el("aside", { class: "side" }, this.drop, this.input, this.work)));
    this.handlers = {
      "studio:folder": () => this.load(), "studio:back": () => this.load(),
      "studio:job": (event) => { this.jobs.set(event.detail.job.id, event.detail.job); this.showJobs(); },
      dragover: (event) => { event.preventDefault(); this.drop.classList.add("over"); },
      dragleave: () => this.drop.classList.remove("over"),
      drop: (event) => { event.preventDefault(); this.drop.classList.remove("over"); this.sendAll([...event.dataTransfer.files]); },
    };
    for (const [name, handler] of Object.entries(this.handlers)) document.addEventListener(name, handler);
    this.load();
  }

  close() { for (const [name, handler] of Object.entries(this.handlers)) document.removeEventListener(name, handler); }

  async load() {
    try {
      const told = await get("/api/folder");
      this.entries = told.entries;
      this.jobs = new Map(told.jobs.map((job) => [job.id, job]));
      document.title = `${told.name} – topomerge studio`;
      for (const path of [...this.chosen]) if (!this.entries.some((one) => one.path === path)) this.chosen.delete(path);
      this.show();
    } catch (error) {
      toast(error.message, "bad");
    }
  }

  async sendAll(files) {
    for (const file of files) { // one after the other: the disk is one
      const row = { name: file.name, share: 0, cancel: () => {} };
      this.uploads.set(file, row);
      try {
        const { path } = await send(file, (share, cancel) => { row.share = share; row.cancel = cancel || row.cancel; this.showJobs(); });
        if (!path.endsWith(".tmap")) await this.start("extract", [path]);
      } catch (error) {
        toast(error.message, "bad");
      }
      this.uploads.delete(file);
      this.showJobs();
    }
    this.load();
  }

  async start(kind, paths) {
    try {
      const { job } = await post("/api/jobs", { kind, paths });
      this.jobs.set(job.id, job);
      this.showJobs();
    } catch (error) {
      toast(error.message, "bad");
    }
  }

  show() {
    const of = (kind) => this.entries.filter((one) => one.kind === kind && !one.of);
    const scans = of("scan");
    const sections = [
      ["Maps", of("map"), (one) => this.showMap(one), "No maps yet: add a scan, and its rooms are found."],
      ["Scans not yet extracted", scans.filter((one) => !one.extracted), (one) => this.showScan(one)],
      ["Merges", of("merge"), (one) => this.showMerge(one)], ["Atlases", of("atlas"), (one) => this.showMerge(one)],
      ["Joined maps", this.entries.filter((one) => one.of), (one) => this.showMap(one)],
      ["Pages", of("page"), (one) => this.showPage(one)],
      ["Scans with a map", scans.filter((one) => one.extracted), (one) => this.showScan(one, true)],
    ];
    showAll(this.list, sections.filter(([, items, , empty]) => items.length || empty).map(([title, items, row, empty]) =>
      el("section", {}, el("h2", {}, title, el("small", {}, items.length ? ` ${items.length}` : "")), items.length ? el("ul", { class: "entries" }, items.map(row)) : el("p", { class: "sub" }, empty))));
    this.showActions();
    this.showJobs();
  }

  row(entry, words, link, ...buttons) {
    const box = entry.kind === "map" || entry.kind === "scan" ? el("input", { type: "checkbox", checked: this.chosen.has(entry.path), ariaLabel: `Choose ${entry.name}`, onchange: (event) => { event.target.checked ? this.chosen.add(entry.path) : this.chosen.delete(entry.path); this.showActions(); } }) : el("span");
    return el("li", { data: { path: entry.path } }, box, el("div", { class: "what" }, link ? el("a", { href: link, ...(link.startsWith("/files/") ? { target: "_blank", rel: "noopener" } : {}) }, entry.of ? entry.path : entry.name) : el("span", {}, entry.name), el("small", {}, words)), el("div", { class: "row" }, buttons));
  }

  showMap(one) {
    const words = one.error ? one.error : `${one.rooms} room${one.rooms === 1 ? "" : "s"} · ${one.storeys} storey${one.storeys === 1 ? "" : "s"} · ${formatBytes(one.bytes)}`;
    return this.row(one, words, one.error ? null : `#/map/${encodePath(one.path)}`, one.error ? null : el("a", { class: "as-button", href: `#/map/${encodePath(one.path)}` }, "Open"));
  }

  showScan(one, known) { return this.row(one, one.format || formatBytes(one.bytes), null, button(known ? "Extract again" : "Extract", () => this.start("extract", [one.path]))); }

  showMerge(one) {
    const sure = typeof one.probability === "number" ? `probability ${formatPercent(one.probability)}` : "";
    const badge = one.status ? el("span", { class: `badge ${one.status}` }, one.status) : null;
    const link = one.kind === "merge" ? `#/merge/${encodePath(one.path)}` : `/files/${encodePath(one.path)}/report.html`;
    return this.row(one, [one.maps.join(" + "), sure].filter(Boolean).join(" · "), link, badge);
  }

  showPage(one) { return this.row(one, one.page ? "what has changed" : formatBytes(one.bytes), `/files/${encodePath(one.page ? `${one.path}/${one.page}` : one.path)}`); }

  showActions() {
    const paths = [...this.chosen], maps = paths.every((path) => path.endsWith(".tmap"));
    this.actions.hidden = !paths.length;
    const act = (words, kind, settings) => button(words, () => { this.start(kind, paths); this.chosen.clear(); this.show(); }, settings);
    this.actions.replaceChildren(el("span", {}, `${paths.length} chosen`),
      ...(paths.length > 1 ? [act("Merge", "merge", { class: "primary" })] : [el("span", { class: "sub" }, "Choose another one to merge or compare them.")]),
      ...(paths.length === 2 ? [act("Compare", "compare", { title: "What has changed from the first to the second" })] : []),
      ...(paths.length === 2 && maps ? [el("a", { class: "as-button", href: `#/match/${paths.map(encodeURIComponent).join("/")}` }, "Match by hand")] : []),
      button("Choose none", () => { this.chosen.clear(); this.show(); }));
  }

  showJobs() {
    const uploads = [...this.uploads.values()].map((row) => el("li", { class: "running" }, el("div", { class: "row" }, el("b", {}, `Send ${row.name}`), el("span", { class: "grow" }), button("Cancel", () => row.cancel())), el("progress", { max: 1, value: row.share })));
    const jobs = [...this.jobs.values()].reverse().map((job) => this.showJob(job));
    this.work.hidden = !(uploads.length + jobs.length);
    showAll(this.rows, [...uploads, ...jobs]);
  }

  showJob(job) {
    const busy = job.state === "running" || job.state === "waiting";
    const steps = Object.entries(job.steps).map(([task, [share, text]]) => el("div", { class: "step" }, el("span", {}, `${task}${text && text !== task ? `: ${text}` : ""}`), el("progress", { max: 1, value: job.state === "done" ? 1 : share })));
    const link = { extract: `#/map/${encodePath(job.result)}`, merge: `#/merge/${encodePath(job.result)}`, compare: `/files/${encodePath(job.result)}` }[job.kind];
    return el("li", { class: job.state, data: { job: job.id, state: job.state } },
      el("div", { class: "row" }, el("b", {}, `${KINDS[job.kind]} ${job.title}`), el("span", { class: "grow" }), busy ? button("Cancel", () => remove(`/api/jobs/${job.id}`)) : null,
        job.state === "done" ? el("a", { class: "as-button", href: link, ...(job.kind === "compare" ? { target: "_blank", rel: "noopener" } : {}) }, "Open") : null),
      el("small", {}, `${STATES[job.state]}${job.seconds ? ` · ${job.seconds} s` : ""}`), busy && !steps.length && job.state === "running" ? el("progress", {}) : null, busy ? steps : null,
      job.lines.length ? el("ul", { class: "said" }, job.lines.slice(-4).map((line) => el("li", {}, line))) : null);
  }
}
