// Distances in the 3D view: two clicks on surfaces, joints of people or centers of cameras. Ends at joints and cameras
// follow them. Lines and texts have the class humansim-label: pictures and videos show them.
"use strict";
(() => {
  const page = window.humansim;
  const SVG = "http://www.w3.org/2000/svg";
  const SNAP = 12; // pixels in which a joint or a camera is taken
  const STILL = 5; // pixels that the pointer may move in a click
  const WITHIN = 0.4; // metres that a joint may be behind the surface that is hit: it is within the body
  const NEAR = 0.02; // metres from the eye, in which nothing is drawn
  const PAUSE = 80; // milliseconds between looks at what is below the pointer
  const ARM = 5; // pixels of the cross at an end
  const INK = "#c2255c";

  const measures = (page.measures = []); // {from, to, distance}; ends are {at: [x, y, z], name, live}
  let active = false;
  let begun = null; // first end of a line
  let below = null; // what is below the pointer
  let pointer = null; // its place, where it was pressed, and when below was looked for
  let tool, clearTool, sheet, hint;

  // --- the frame map and the frame of three.js, whose y is up (viser, set_up_direction) -----------------------
  const toThree = ([x, y, z], vector) => vector.set(-y, z, -x);
  const toMap = ({ x, y, z }) => [-z, -x, y];
  const canvasBox = () => document.querySelector("canvas").getBoundingClientRect();
  const vector = () => page.camera.position.clone();

  // Point (3,) in map, as x, y of the page and depth in metres, with the projection that the 3D view has.
  function project(point) {
    const { camera } = page;
    const seen = toThree(point, vector()).applyMatrix4(camera.matrixWorldInverse);
    const depth = -seen.z;
    const at = seen.applyMatrix4(camera.projectionMatrix);
    const box = canvasBox();
    return { x: box.left + ((at.x + 1) / 2) * box.width, y: box.top + ((1 - at.y) / 2) * box.height, depth };
  }

  function rayAt(x, y) {
    const { camera } = page;
    const box = canvasBox();
    const ahead = vector().set((2 * (x - box.left)) / box.width - 1, 1 - (2 * (y - box.top)) / box.height, 0.5);
    ahead.applyMatrix4(camera.projectionMatrixInverse).applyMatrix4(camera.matrixWorld);
    const origin = vector().setFromMatrixPosition(camera.matrixWorld);
    const direction = ahead.sub(origin).normalize();
    // skinned meshes of three.js ask the ray for it; our ray is no Ray of three.js, whose classes are hidden
    const intersectsSphere = ({ center, radius }) => {
      const to = center.clone().sub(origin);
      return to.addScaledVector(direction, -Math.max(0, to.dot(direction))).length() <= radius;
    };
    return { origin, direction, intersectsSphere };
  }

  // --- what is below the pointer ------------------------------------------------------------------------------
  // Surfaces of people, objects and the room; where there are none, the floor.
  function surfaceAt(x, y) {
    const ray = rayAt(x, y);
    const caster = { ray, near: 0, far: Infinity, camera: page.camera, params: {} };
    const hits = [];
    page.scene.traverseVisible((node) => {
      if (node.isMesh && node.material && node.material.isMeshStandardMaterial)
        Object.getPrototypeOf(node).raycast.call(node, caster, hits); // of people it is switched off, see rest()
    });
    if (hits.length) return toMap(hits.reduce((best, hit) => (hit.distance < best.distance ? hit : best)).point);
    const [origin, direction] = [toMap(ray.origin), toMap(ray.direction)];
    const along = -origin[2] / direction[2];
    return along > 0 && along < 1e3 ? origin.map((value, axis) => value + along * direction[axis]) : null;
  }

  // Joints of people and centers of cameras: {name, live}; live gives the place (3,) as long as there is one.
  function* marks() {
    for (const key of page.posed()) {
      const { name, joints } = page.tableOf(key) || { joints: [] };
      for (const [number, joint] of joints.entries())
        yield { name: `${name}: ${joint}`, live: () => page.jointOf(key, number) };
    }
    for (const name of Object.keys(page.cameras)) yield { name, live: () => page.cameras[name], free: true };
  }

  function endAt(x, y) {
    const surface = surfaceAt(x, y);
    const depth = surface ? project(surface).depth : Infinity;
    let [best, least] = [null, SNAP];
    for (const mark of marks()) {
      const at = mark.live();
      if (!at) continue;
      const seen = project(at);
      const distance = Math.hypot(seen.x - x, seen.y - y);
      if (distance > least || seen.depth < NEAR || seen.depth > depth + WITHIN) continue;
      [best, least] = [{ ...mark, at }, distance];
    }
    return best || (surface && { at: surface, name: "", live: () => null });
  }

  function placeOf(end) {
    end.at = end.live() || end.at;
    return end.at;
  }

  // --- drawing ------------------------------------------------------------------------------------------------
  const number = (value) => (Math.abs(value) < 0.0005 ? 0 : value).toFixed(3);

  function made(kind, namespace) {
    return namespace ? document.createElementNS(namespace, kind) : document.createElement(kind);
  }

  function label(style) {
    const text = made("span");
    text.className = "humansim-label";
    Object.assign(text.style, {
      position: "fixed",
      zIndex: 6,
      transform: "translate(-50%, -50%)",
      font: "12px/1.3 system-ui, sans-serif",
      whiteSpace: "nowrap",
      padding: "0 .3em",
      color: "#fff",
      background: INK,
      pointerEvents: "none",
      ...style,
    });
    document.body.append(text);
    return text;
  }

  function drawn() {
    const lines = Array.from({ length: 5 }, () => {
      const line = made("line", SVG);
      line.setAttribute("class", "humansim-label");
      line.setAttribute("stroke", INK);
      line.setAttribute("stroke-width", "2");
      sheet.append(line);
      return line;
    });
    return { lines, texts: [label({ fontSize: "14px" }), label({ color: "#212529", background: "#fff" })] };
  }

  function remove({ lines, texts }) {
    for (const element of [...lines, ...texts]) element.remove();
  }

  function setLine(line, box, from, to) {
    line.style.display = from ? "" : "none";
    if (!from) return;
    const values = { x1: from[0] - box.left, y1: from[1] - box.top, x2: to[0] - box.left, y2: to[1] - box.top };
    for (const [name, value] of Object.entries(values)) line.setAttribute(name, value.toFixed(2));
  }

  // Part of a line in the frame map that is before the eye and in the canvas, as two points of the page; or null.
  function shownPart(from, to, box) {
    const depths = [project(from).depth, project(to).depth];
    if (Math.max(...depths) < NEAR) return null;
    const cut = (NEAR - depths[0]) / (depths[1] - depths[0]);
    const between = from.map((value, axis) => value + cut * (to[axis] - value));
    const ends = [from, to].map((point, i) => project(depths[i] < NEAR ? between : point));
    const [x, y] = [ends[0].x, ends[0].y];
    const [across, down] = [ends[1].x - x, ends[1].y - y];
    let [first, last] = [0, 1];
    for (const [step, room] of [
      [-across, x - box.left],
      [across, box.right - x],
      [-down, y - box.top],
      [down, box.bottom - y],
    ]) {
      if (step === 0 && room < 0) return null;
      if (step < 0) first = Math.max(first, room / step);
      if (step > 0) last = Math.min(last, room / step);
    }
    if (first > last) return null;
    return [first, last].map((share) => [x + share * across, y + share * down]);
  }

  function inCanvas(point, box) {
    const { x, y, depth } = project(point);
    return depth > NEAR && x > box.left && x < box.right && y > box.top && y < box.bottom ? [x, y] : null;
  }

  function draw(shape, start, end, box) {
    const [from, to] = [placeOf(start), placeOf(end)];
    const part = shownPart(from, to, box);
    setLine(shape.lines[0], box, ...(part || []));
    [from, to].forEach((point, i) => {
      const at = inCanvas(point, box);
      const arms = [1, -1].map((sign) => [at && [at[0] - ARM, at[1] - sign * ARM], at && [at[0] + ARM, at[1] + sign * ARM]]);
      arms.forEach((arm, j) => setLine(shape.lines[1 + 2 * i + j], box, ...arm));
    });
    const steps = from.map((value, axis) => to[axis] - value);
    const distance = Math.hypot(...steps);
    const [dx, dy, dz] = steps.map(number);
    [`${number(distance)} m`, `dx ${dx}, dy ${dy}, dz ${dz} m`].forEach((text, i) => {
      const element = shape.texts[i];
      element.style.display = part ? "" : "none";
      if (!part) return;
      if (element.textContent !== text) element.textContent = text;
      element.style.left = `${(part[0][0] + part[1][0]) / 2}px`;
      element.style.top = `${(part[0][1] + part[1][1]) / 2 + 17 * i}px`;
    });
    return distance;
  }

  let band = null; // from the first end to the pointer
  let mark = null; // name of what is below the pointer
  function show() {
    requestAnimationFrame(show);
    if (!page.camera || !document.querySelector("canvas")) return;
    const box = canvasBox();
    const image = Boolean(page.page && page.page.through && page.page.through.lens);
    sheet.style.display = image || !measures.length && !active ? "none" : "";
    Object.assign(sheet.style, { left: `${box.left}px`, top: `${box.top}px` });
    Object.assign(sheet.style, { width: `${box.width}px`, height: `${box.height}px` });
    clearTool.style.display = measures.length ? "" : "none";
    tellHint(box, image);
    if (active && !image) look();
    for (const each of measures) {
      each.distance = draw(each.shape, each.from, each.to, box);
      for (const text of each.shape.texts) if (image) text.style.display = "none";
    }
    const shown = active && !image && below;
    if (begun && shown) draw((band = band || drawn()), begun, below, box);
    else if (band) {
      remove(band);
      band = null;
    }
    mark.style.display = shown && below.name ? "" : "none";
    if (!shown || !below.name) return;
    const at = project(placeOf(below));
    mark.textContent = below.name;
    Object.assign(mark.style, { left: `${at.x}px`, top: `${at.y - 16}px` });
  }

  function tellHint(box, image) {
    hint.style.display = active ? "" : "none";
    hint.style.left = `${box.left + box.width / 2}px`;
    hint.style.top = `${box.top + 16}px`;
    const first = image ? "An image has no depth: show 3D from its position" : "Click a surface, joint or camera";
    hint.textContent = begun ? "Click the second end (Esc: drop the first)" : `${first} (Esc: end)`;
  }

  // --- the tool -------------------------------------------------------------------------------------------------
  function look() {
    const now = performance.now();
    if (!pointer || pointer.pressed || !pointer.moved || now - pointer.looked < PAUSE) return;
    Object.assign(pointer, { looked: now, moved: false });
    below = endAt(pointer.x, pointer.y);
  }

  // Clicks are not for the people meanwhile, who would show their numbers.
  function rest() {
    for (const meshes of (page.meshes || new Map()).values())
      for (const mesh of meshes) {
        if (active) mesh.raycast = () => {};
        else delete mesh.raycast;
      }
  }

  function toggle(wanted) {
    active = wanted;
    begun = below = null;
    tool.setAttribute("aria-pressed", String(active));
    Object.assign(tool.style, active ? { background: INK, color: "#fff" } : { background: "#fffd", color: "#212529" });
    for (const canvas of document.querySelectorAll("canvas")) canvas.style.cursor = active ? "crosshair" : "";
    rest();
  }

  function clear() {
    for (const { shape } of measures.splice(0)) remove(shape);
  }

  function click(x, y) {
    if (!page.camera || (page.page && page.page.through && page.page.through.lens)) return;
    const end = endAt(x, y);
    if (!end) return;
    if (begun) measures.push({ from: begun, to: end, distance: 0, shape: drawn() });
    begun = begun ? null : end;
  }

  const isScene = (event) => event.target.tagName === "CANVAS";
  window.addEventListener("pointermove", (event) => {
    if (active) pointer = { looked: 0, ...pointer, x: event.clientX, y: event.clientY, moved: isScene(event) };
    if (active && !isScene(event)) below = null;
  }, true);
  window.addEventListener("pointerdown", (event) => {
    if (active && isScene(event) && event.button === 0)
      pointer = { looked: 0, ...pointer, pressed: [event.clientX, event.clientY] };
  }, true);
  window.addEventListener("pointerup", (event) => {
    if (!active || !pointer || !pointer.pressed || event.button !== 0) return;
    const [x, y] = pointer.pressed;
    pointer.pressed = null;
    if (Math.hypot(event.clientX - x, event.clientY - y) <= STILL) click(event.clientX, event.clientY);
  }, true);
  page.addEventListener("escape", () => {
    if (begun) begun = null;
    else if (active) toggle(false);
    else clear();
  });

  document.addEventListener("DOMContentLoaded", () => {
    sheet = made("svg", SVG);
    Object.assign(sheet.style, { position: "fixed", zIndex: 6, overflow: "hidden", pointerEvents: "none" });
    document.body.append(sheet);
    hint = label({ background: "#222e", padding: ".1em .6em" });
    hint.className = ""; // not for pictures
    hint.setAttribute("role", "status");
    mark = label({ background: "#222e" });
    tool = page.addTool("Measure", "Distance between two clicks on surfaces, joints or cameras", () => toggle(!active));
    clearTool = page.addTool("Clear measures", "Remove all distances (Esc)", clear);
    toggle(false);
    setInterval(rest, 500); // meshes of new people
    requestAnimationFrame(show);
  });
})();
