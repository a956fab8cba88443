// The timeline along the bottom of the page: tracks of people, keyframes, visibility and drops, and curves.
// The server reads them in the background (tracks.py) and tells a new version in the state; a click or a drag
// moves the time of the page.
"use strict";
(() => {
  const page = window.humansim;
  const NONE = "no curve";
  const LINES = ["#1c7ed6", "#e8590c", "#2f9e44", "#9c36b5", "#0c8599", "#c92a2a", "#5f3dc4", "#868e96"];
  const LOW = 700; // height of a page, pixels
  const HEIGHT = { ruler: 18, person: 16, camera: 11, object: 16, drops: 12, curve: 84 };
  const STYLE = `
    #humansim-timeline { position: fixed; left: 0; right: 0; bottom: 0; z-index: 150; box-sizing: border-box;
      font: 12px/1.3 system-ui, sans-serif; color: var(--ht-text); background: var(--ht-back);
      border-top: 1px solid var(--ht-line); --ht-text: #222; --ht-back: #fff; --ht-line: #ccd; --ht-soft: #eef0f3; }
    [data-mantine-color-scheme="dark"] #humansim-timeline { --ht-text: #ddd; --ht-back: #1f2023; --ht-line: #444;
      --ht-soft: #2e3035; }
    #humansim-timeline .head { display: flex; gap: 8px; align-items: center; height: 28px; padding: 0 8px;
      overflow: hidden; white-space: nowrap; }
    #humansim-timeline button, #humansim-timeline select { font: inherit; height: 22px; color: inherit;
      background: var(--ht-soft); border: 1px solid var(--ht-line); border-radius: 4px; min-width: 26px; }
    #humansim-timeline select { max-width: 11em; }
    #humansim-timeline :focus-visible { outline: 2px solid #1c7ed6; outline-offset: -2px; }
    #humansim-timeline .status { flex: 1; overflow: hidden; text-overflow: ellipsis; text-align: right; }
    #humansim-timeline .body { position: relative; overflow: hidden auto; max-height: 26vh; }
    #humansim-timeline .rows { display: flex; position: relative; }
    #humansim-timeline .labels { flex: none; width: var(--ht-labels); overflow: hidden; user-select: none; }
    #humansim-timeline .labels div { padding: 0 4px 0 8px; overflow: hidden; text-overflow: ellipsis;
      white-space: nowrap; box-sizing: border-box; display: flex; align-items: center; }
    #humansim-timeline .labels .camera { font-size: 9px; line-height: 1; padding-left: 16px; opacity: .8; }
    #humansim-timeline .area { position: relative; flex: 1; min-width: 0; margin-right: 12px; cursor: pointer;
      touch-action: pan-y; }
    #humansim-timeline canvas { display: block; width: 100%; }
    #humansim-timeline .cursor { position: absolute; top: 0; bottom: 0; left: 0; width: 2px; margin-left: -1px;
      background: #e03131; pointer-events: none; }
    #humansim-timeline .values { position: absolute; pointer-events: none; padding: 1px 5px; white-space: pre;
      background: var(--ht-back); border: 1px solid var(--ht-line); border-radius: 4px; opacity: .93; }
    #humansim-timeline[data-open="false"] .body { display: none; }
    @media (max-width: 700px) { #humansim-timeline { --ht-labels: 84px !important; } }`;

  let table = null; // what tracks.json says
  let made = null; // elements of the timeline
  let rows = []; // {kind, name, label, top, height, ...}
  let shown = { version: null, frame: null, width: 0, scheme: "" };
  const chosen = { curve: NONE, person: "", joint: "" };
  let open = true;

  function element(kind, name, attributes = {}, parent = null) {
    const node = document.createElement(kind);
    if (name) node.className = name;
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    if (parent) parent.append(node);
    return node;
  }

  const last = () => Math.max(1, table.frames - 1);
  const seconds = (frame) => `${(frame * table.period).toFixed(3)} s`;
  const text = (words) => words.filter(Boolean).join(", ");

  // --- the elements --------------------------------------------------------------------------------------

  function build() {
    const style = element("style", "", {}, document.head);
    style.textContent = STYLE;
    const bar = element("section", "", { id: "humansim-timeline", "aria-label": "Timeline" }, document.body);
    bar.style.setProperty("--ht-labels", "112px");
    const head = element("div", "head", {}, bar);
    const toggle = element("button", "", { type: "button", "aria-controls": "humansim-tracks" }, head);
    toggle.addEventListener("click", () => setOpen(!open));
    const play = element("button", "", { type: "button", "aria-label": "Play or pause", title: "Space" }, head);
    play.innerHTML =
      '<svg width="16" height="10" viewBox="0 0 16 10" fill="currentColor" aria-hidden="true">' +
      '<path d="M0 0 8 5 0 10ZM10 0h2v10h-2ZM14 0h2v10h-2Z"/></svg>';
    play.addEventListener("click", start);
    const time = element("span", "time", {}, head);
    const select = (label) => {
      const list = element("select", "", { "aria-label": label, title: label }, head);
      list.addEventListener("change", choose);
      return list;
    };
    const [curve, person, joint] = [select("Curve"), select("Person of the curve"), select("Joint of the curve")];
    const status = element("span", "status", { role: "status" }, head);
    const body = element("div", "body", { id: "humansim-tracks" }, bar);
    const inner = element("div", "rows", {}, body);
    const labels = element("div", "labels", { role: "list", "aria-label": "Tracks" }, inner);
    const area = element("div", "area", { role: "slider", tabindex: "0", "aria-label": "Time" }, inner);
    const canvas = element("canvas", "", { "aria-hidden": "true" }, area);
    const cursor = element("div", "cursor", {}, area);
    const values = element("div", "values", { hidden: "", "aria-hidden": "true" }, area);
    made = { style, bar, head, toggle, time, curve, person, joint, status, body, labels, area, canvas, cursor, values };
    area.addEventListener("pointerdown", (event) => {
      if (event.button) return;
      area.setPointerCapture(event.pointerId);
      seek(frameAt(event), true);
    });
    area.addEventListener("pointermove", (event) => {
      if (area.hasPointerCapture(event.pointerId)) seek(frameAt(event), true);
    });
    area.addEventListener("pointerup", (event) => seek(frameAt(event), false));
    area.addEventListener("keydown", key);
    new ResizeObserver(place).observe(bar);
    setOpen(window.innerHeight >= 500);
    if (window.innerHeight < LOW && !table.live) foldTime();
  }

  // Fold the folder of the time, whose controls the timeline has, too: on a low page the tabs need its place.
  function foldTime() {
    const folders = [...document.querySelectorAll(".mantine-Paper-root")];
    const title = folders.find((node) => node.textContent === "Time" && node.querySelector("svg"));
    if (!title) return made && setTimeout(foldTime, 100); // the panel is not there yet
    if (title.querySelector(".tabler-icon-chevron-up")) title.click();
  }

  function setOpen(value) {
    open = value;
    made.bar.dataset.open = open;
    made.toggle.textContent = open ? "▾" : "▴";
    made.toggle.setAttribute("aria-expanded", open);
    made.toggle.setAttribute("aria-label", open ? "Hide the tracks" : "Show the tracks");
    shown.version = null;
  }

  // The scene, its panels and the images end above the timeline.
  function place() {
    page.reserve("timeline", "Bottom", made ? made.bar.offsetHeight : 0);
  }

  function remove() {
    if (!made) return;
    made.bar.remove();
    made.style.remove();
    made = null;
    place();
  }

  // --- the time ------------------------------------------------------------------------------------------

  function frameAt(event) {
    const box = made.area.getBoundingClientRect();
    return Math.round(((event.clientX - box.left) / box.width) * last());
  }

  let busy = false;
  let next = null;
  let goal = null; // frame that was asked for last, and until when keys count from it
  function ask(what) {
    return fetch(`/humansim/${what}`).catch(() => {});
  }

  function start() {
    goal = null;
    ask("key?action=play");
  }

  // One request at a time, and then the latest: a drag does not queue up.
  async function seek(frame, drag) {
    if (table.live) return; // a graph has no time but now
    goal = { frame: Math.min(Math.max(frame, 0), last()), until: performance.now() + 1000 };
    next = `seek?frame=${goal.frame}${drag ? "&drag=1" : ""}`;
    if (busy) return;
    busy = true;
    while (next) {
      const wanted = next;
      next = null;
      await ask(wanted);
    }
    busy = false;
  }

  function key(event) {
    const steps = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageDown: -10, PageUp: 10 };
    if (event.altKey || event.metaKey || event.ctrlKey) return;
    const from = goal && performance.now() < goal.until ? goal.frame : shown.frame || 0;
    if (event.key in steps) seek(from + steps[event.key], false);
    else if (event.key === "Home") seek(0, false);
    else if (event.key === "End") seek(last(), false);
    else if (event.key === " ") start();
    else return;
    event.preventDefault();
  }

  // --- what is chosen ------------------------------------------------------------------------------------

  function fill(list, names, value) {
    const wanted = JSON.stringify(names);
    if (list.dataset.names !== wanted) {
      list.dataset.names = wanted;
      list.replaceChildren(...names.map((name) => new Option(name, name)));
    }
    if (names.includes(value)) list.value = value;
  }

  function fillLists() {
    const people = (table.people || []).map((person) => person.name);
    const curves = [NONE];
    if (people.length) curves.push("joint position");
    if (Object.keys(table.visible || {}).length) curves.push("visibility");
    if (Object.keys((table.errors || {}).values || {}).length) curves.push("estimate error");
    if (!curves.includes(chosen.curve)) chosen.curve = NONE;
    if (!people.includes(chosen.person)) chosen.person = people[0] || "";
    const joints = (table.joints || {})[chosen.person] || [];
    if (!joints.includes(chosen.joint)) chosen.joint = joints[0] || "";
    fill(made.curve, curves, chosen.curve);
    fill(made.person, people, chosen.person);
    fill(made.joint, joints, chosen.joint);
    made.curve.hidden = curves.length < 2;
    made.person.hidden = chosen.curve === NONE || people.length < 2 || (chosen.curve === "estimate error" && people.length <= LINES.length);
    made.joint.hidden = chosen.curve !== "joint position";
  }

  function choose() {
    chosen.curve = made.curve.value;
    chosen.person = made.person.value;
    chosen.joint = made.joint.value;
    fillLists();
    if (chosen.curve === "joint position")
      ask(`curve?person=${encodeURIComponent(chosen.person)}&joint=${encodeURIComponent(chosen.joint)}`);
    shown.version = null;
  }

  // The chosen curve: {unit, low, high, lines: [{name, color, frames, values}]}; null without one.
  function curve() {
    const lines = [];
    const add = (name, frames, values) =>
      lines.push({ name, color: LINES[lines.length % LINES.length], frames, values });
    let [unit, low, high] = ["", 0, 100];
    if (chosen.curve === "visibility") {
      unit = "%";
      for (const [name, values] of Object.entries((table.visible || {})[chosen.person] || {}))
        add(name, table.sampled, values);
    } else if (chosen.curve === "estimate error") {
      unit = "mm";
      const { frames, values } = table.errors;
      const people = Object.keys(values);
      for (const name of people)
        if (people.length <= LINES.length || name === chosen.person) add(name, frames, values[name]);
    } else if (chosen.curve === "joint position") {
      unit = "m";
      const given = table.curve;
      if (given && given.person === chosen.person && given.joint === chosen.joint)
        for (const [axis, values] of Object.entries(given.lines)) add(axis, given.frames, values);
    } else return null;
    if (unit !== "%") {
      const all = lines.flatMap((line) => line.values.filter((value) => value !== null));
      [low, high] = [Math.min(0, ...all), Math.max(unit === "mm" ? 1 : 0.1, ...all)];
    }
    return { unit, low, high, lines };
  }

  // Value at the sample that is nearest to a frame.
  function valueAt(frames, values, frame) {
    if (!frames || !frames.length) return null;
    let best = 0;
    for (let i = 1; i < frames.length; i += 1)
      if (Math.abs(frames[i] - frame) < Math.abs(frames[best] - frame)) best = i;
    return values[best] === undefined ? null : values[best];
  }

  const written = (value, unit) => (value === null ? "–" : `${unit === "m" ? value.toFixed(2) : Math.round(value)} ${unit}`);

  // --- drawing -------------------------------------------------------------------------------------------

  function layOut() {
    rows = [];
    let top = HEIGHT.ruler;
    const add = (kind, label, more = {}) => {
      const row = { kind, label, top, height: HEIGHT[kind], ...more };
      rows.push(row);
      top += row.height;
    };
    const keys = table.keys || {};
    const graph = curve();
    if (graph) add("curve", chosen.curve, { graph, height: window.innerHeight < 700 ? 62 : HEIGHT.curve });
    for (const person of table.people || []) {
      add("person", person.name, { person, keys: keys[person.name] || [] });
      for (const camera of table.visible && table.visible[person.name] ? table.cameras : [])
        add("camera", camera, { person, camera });
    }
    const people = new Set((table.people || []).map((person) => person.name));
    for (const [name, frames] of Object.entries(keys))
      if (!people.has(name)) add("object", name, { keys: frames });
    for (const [name, frames] of Object.entries(table.drops || {}))
      add("drops", `drops ${name}`, { drops: frames, dropped: table.dropped[name] });
    return top + 2;
  }

  function mean(values) {
    const known = (values || []).filter((value) => value !== null);
    return known.length ? Math.round(known.reduce((sum, value) => sum + value, 0) / known.length) : null;
  }

  // What a row shows, in words.
  function described(row) {
    if (row.kind === "camera") {
      const seen = mean(table.visible[row.person.name][row.camera]);
      return `${row.person.name} in ${row.camera}: ${seen === null ? "not known yet" : `${seen} % of the joints ${(table.projected || []).includes(row.camera) ? "in the image" : "visible"}, mean`}`;
    }
    if (row.kind === "drops") return `${row.label}: ${row.dropped} of ${table.frames} frames`;
    if (row.kind === "curve") return `Curve: ${text([chosen.curve, !made.person.hidden && chosen.person, chosen.curve === "joint position" && chosen.joint])}`;
    return text([row.label, row.keys.length && `${row.keys.length} keyframes`]);
  }

  function drawLabels() {
    const ruler = element("div", "", { "aria-hidden": "true" });
    ruler.style.height = `${HEIGHT.ruler}px`;
    made.labels.replaceChildren(
      ruler,
      ...rows.map((row) => {
        const label = element("div", row.kind, { role: "listitem", title: described(row), "aria-label": described(row) });
        label.textContent = row.label;
        label.style.height = `${row.height}px`;
        if (row.person && row.kind === "person") label.style.fontWeight = "600";
        return label;
      }),
    );
  }

  function draw() {
    const height = layOut();
    drawLabels();
    const { canvas, area, bar } = made;
    const width = area.clientWidth;
    const scale = window.devicePixelRatio || 1;
    canvas.width = Math.round(width * scale);
    canvas.height = Math.round(height * scale);
    canvas.style.height = `${height}px`;
    const style = getComputedStyle(bar);
    const [ink, line, soft] = ["--ht-text", "--ht-line", "--ht-soft"].map((name) => style.getPropertyValue(name));
    const paint = canvas.getContext("2d");
    paint.scale(scale, scale);
    paint.font = "10px system-ui, sans-serif";
    const x = (frame) => (frame / last()) * width;
    drawRuler(paint, width, height, x, ink, line);
    for (const row of rows) {
      if (row.kind === "person") {
        paint.fillStyle = soft;
        paint.fillRect(0, row.top + 2, width, row.height - 4);
        paint.fillStyle = row.person.color || "#888";
        for (const [first, end] of row.person.spans)
          paint.fillRect(x(first), row.top + 4, Math.max(2, x(end) - x(first)), row.height - 8);
      }
      if (row.keys) drawKeys(paint, row, x, ink);
      if (row.kind === "camera") drawVisibility(paint, row, x, soft);
      if (row.kind === "drops") {
        paint.fillStyle = "#e03131";
        for (const frame of row.drops) paint.fillRect(x(frame) - 1, row.top + 2, 2, row.height - 4);
      }
      if (row.kind === "curve") drawCurve(paint, row, width, x, ink, line);
    }
  }

  function drawRuler(paint, width, height, x, ink, line) {
    const whole = table.frames * table.period;
    const steps = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300];
    const step = steps.find((each) => (each / whole) * width > 55) || 600;
    paint.fillStyle = ink;
    paint.strokeStyle = line;
    paint.textBaseline = "middle";
    for (let number = 0; number * step < whole; number += 1) {
      const away = (number * step) / table.period; // of a graph: back from now
      const at = x(table.live ? last() - away : away);
      if (at > width - 1 && !table.live) break;
      paint.beginPath();
      paint.moveTo(at, HEIGHT.ruler - 5);
      paint.lineTo(at, height);
      paint.stroke();
      const label = `${table.live && number ? "−" : ""}${+(number * step).toFixed(2)} s`;
      if (at + paint.measureText(label).width < width) paint.fillText(label, at + 2, 7);
    }
  }

  function drawKeys(paint, row, x, ink) {
    const middle = row.top + row.height / 2;
    paint.fillStyle = ink;
    for (const frame of row.keys) {
      paint.save();
      paint.translate(x(frame), middle);
      paint.rotate(Math.PI / 4);
      paint.fillRect(-4, -4, 8, 8);
      paint.restore();
    }
  }

  // Height: visible joints; the pale part above them: occluded ones; empty: outside the image.
  function drawVisibility(paint, row, x, soft) {
    const { sampled } = table;
    const visible = table.visible[row.person.name][row.camera];
    const occluded = table.occluded[row.person.name][row.camera];
    const [top, height] = [row.top + 1, row.height - 2];
    paint.fillStyle = soft;
    paint.fillRect(0, top, x(last()), height);
    sampled.forEach((frame, i) => {
      if (visible[i] === null) return;
      const left = i ? x((sampled[i - 1] + frame) / 2) : 0;
      const right = i + 1 < sampled.length ? x((frame + sampled[i + 1]) / 2) : x(last());
      const [seen, hidden] = [(visible[i] / 100) * height, (occluded[i] / 100) * height];
      paint.fillStyle = row.person.color || "#888";
      paint.fillRect(left, top + height - seen, right - left + 0.3, seen);
      paint.globalAlpha = 0.3;
      paint.fillRect(left, top + height - seen - hidden, right - left + 0.3, hidden);
      paint.globalAlpha = 1;
    });
  }

  function drawCurve(paint, row, width, x, ink, line) {
    const { low, high, unit, lines } = row.graph;
    const [top, height] = [row.top + 6, row.height - 12];
    const y = (value) => top + height * (1 - (value - low) / (high - low || 1));
    paint.strokeStyle = line;
    paint.strokeRect(0.5, top, width - 1, height);
    if (low < 0) {
      paint.beginPath();
      paint.moveTo(0, y(0));
      paint.lineTo(width, y(0));
      paint.stroke();
    }
    paint.lineWidth = 1.5;
    for (const each of lines) {
      paint.strokeStyle = each.color;
      paint.beginPath();
      let begun = false;
      each.frames.forEach((frame, i) => {
        const value = each.values[i];
        if (value === null || value === undefined) begun = false;
        else if (begun) paint.lineTo(x(frame), y(value));
        else {
          paint.moveTo(x(frame), y(value));
          begun = true;
        }
      });
      paint.stroke();
    }
    paint.lineWidth = 1;
    paint.fillStyle = ink;
    paint.fillText(written(high, unit), 3, top + 7);
    paint.fillText(written(low, unit), 3, top + height - 7);
  }

  function moveCursor() {
    const frame = table.live ? last() : page.frame || 0;
    const { area, cursor, time, values } = made;
    const width = area.clientWidth;
    const at = (Math.min(frame, last()) / last()) * width;
    cursor.style.transform = `translateX(${at}px)`;
    time.textContent = table.live
      ? `live, the last ${Math.round(table.frames * table.period)} s`
      : `${seconds(frame)} · frame ${frame} of 0–${table.frames - 1}`;
    const row = rows.find((each) => each.kind === "curve");
    values.hidden = !row || !row.graph.lines.length;
    const words = [];
    if (!values.hidden) {
      const { lines, unit } = row.graph;
      values.replaceChildren(
        ...lines.map((each) => {
          const value = written(valueAt(each.frames, each.values, frame), unit);
          words.push(`${each.name} ${value}`);
          const entry = element("div");
          entry.style.color = each.color;
          entry.textContent = `${each.name} ${value}`;
          return entry;
        }),
      );
      values.style.top = `${row.top + 8}px`;
      const flip = at > width / 2;
      values.style.left = flip ? "auto" : `${at + 8}px`;
      values.style.right = flip ? `${width - at + 8}px` : "auto";
      if (lines.length > 4) Object.assign(values.style, { columnCount: 2 });
      else values.style.columnCount = "auto";
    }
    const now = { "aria-valuemin": 0, "aria-valuemax": table.frames - 1, "aria-valuenow": frame };
    for (const [name, value] of Object.entries(now)) area.setAttribute(name, value);
    area.setAttribute("aria-readonly", Boolean(table.live));
    area.setAttribute("aria-valuetext", text([...(table.live ? ["now"] : [`frame ${frame}`, seconds(frame)]), ...words]));
  }

  function tell() {
    let words = table.problem || "";
    if (!words && table.live) words = "";
    else if (!words && table.planned && table.sampled.length < table.planned)
      words = `visibility: ${table.sampled.length} of ${table.planned} frames`;
    else if (!words && table.frames > table.curves)
      words = text([`of ${table.frames} frames, curves show ${table.curves}`, table.planned && `visibility ${table.planned}`]);
    if (made.status.textContent !== words) made.status.textContent = words;
    made.status.title = words;
  }

  // --- following the page --------------------------------------------------------------------------------

  let loading = null;
  async function load(version) {
    if (loading === version) return;
    loading = version;
    try {
      const answer = await fetch(`/humansim/tracks.json?${version}`);
      if (!answer.ok || loading !== version) return;
      table = await answer.json();
      shown.version = null;
    } catch (_) {
      loading = null; // the server has ended; keys.js says so
    }
  }

  function follow() {
    requestAnimationFrame(follow);
    const version = page.page && page.page.tracks;
    if (!version || !document.body || !document.querySelector("canvas")) {
      if (page.page && !version) remove();
      return;
    }
    load(version);
    if (!table) return;
    if (!made) build();
    const scheme = document.documentElement.dataset.mantineColorScheme || "";
    const width = made.area.clientWidth;
    const changed = shown.version !== loading || shown.width !== width || shown.scheme !== scheme;
    if (changed) {
      shown = { ...shown, version: loading, width, scheme };
      fillLists();
      tell();
      draw();
    }
    if (changed || shown.frame !== page.frame) {
      shown.frame = page.frame;
      moveCursor();
    }
  }
  requestAnimationFrame(follow);
})();
