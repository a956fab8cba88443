// Photographs beside the 3D scene: points are set, dragged and removed over them. The state comes from
// photographs.json of the server; every edit is a request, and the server says what has become of it.
"use strict";
(() => {
  const SVG = "http://www.w3.org/2000/svg";
  const COLOURS = { 1: "#4aa8ff", "-1": "#ff6b5e", 0: "#ffd84d" };
  const STYLE = `
    #hs-photos{position:fixed;z-index:5;background:#202124;color:#eee;font:13px system-ui,sans-serif;display:flex;
      flex-direction:column;left:0;top:0;width:var(--hs-width);height:var(--hs-height)}
    #root{position:fixed!important;right:0;bottom:0;height:auto!important;width:auto!important}
    @media (min-aspect-ratio:1/1){:root{--hs-width:50vw;--hs-height:100vh}#root{left:50vw;top:0}}
    @media (max-aspect-ratio:1/1){:root{--hs-width:100vw;--hs-height:50vh}#root{left:0;top:50vh}}
    #hs-photos .bar{display:flex;gap:6px;align-items:center;padding:6px;flex-wrap:wrap}
    #hs-photos button,#hs-photos select{background:#3c4043;color:#eee;border:0;border-radius:4px;padding:5px 9px;
      font:inherit;cursor:pointer}
    #hs-photos button:disabled{opacity:.4}
    #hs-photos .grid{flex:1;display:grid;gap:4px;padding:0 6px 6px;overflow:auto;align-content:start;
      grid-template-columns:repeat(var(--columns),minmax(0,1fr))}
    #hs-photos figure{margin:0;background:#111;border:2px solid transparent;border-radius:4px}
    #hs-photos figure.chosen{border-color:#8ab4f8}
    #hs-photos figcaption{display:flex;gap:6px;align-items:center;padding:3px 6px}
    #hs-photos figcaption b{flex:1;overflow:hidden;text-overflow:ellipsis;white-space:nowrap}
    #hs-photos figcaption button{padding:1px 7px}
    #hs-photos svg{display:block;width:100%;touch-action:none;cursor:crosshair;user-select:none}
    #hs-photos .large{grid-column:1/-1}
    #hs-photos .hidden{display:none}
    #hs-photos .point{cursor:grab}
    #hs-photos text{paint-order:stroke;stroke:#000;stroke-width:.22em;fill:#fff;pointer-events:none}`;
  const state = { version: null, data: null, point: 0, view: null, large: null };
  window.humansimPhotographs = state;
  const views = new Map();
  let panel, grid, chooser, told, removeButton;

  function element(kind, attributes, parent, namespace) {
    const made = namespace ? document.createElementNS(namespace, kind) : document.createElement(kind);
    for (const [name, value] of Object.entries(attributes || {})) made.setAttribute(name, value);
    if (parent) parent.append(made);
    return made;
  }
  const shape = (kind, attributes, parent) => element(kind, attributes, parent, SVG);
  function button(text, title, action, parent) {
    const made = element("button", { title, type: "button" }, parent);
    made.textContent = text;
    made.addEventListener("click", action);
    return made;
  }

  // --- talking with the server -----------------------------------------------------------------------------
  let timer = null;
  async function poll() {
    clearTimeout(timer);
    try {
      const version = await (await fetch("/humansim/photographs_version.json")).json();
      if (version !== state.version && !dragging) {
        state.data = await (await fetch("/humansim/photographs.json")).json();
        state.version = version;
        show();
      }
    } catch (_) {
      // the server begins or has ended; viser says so
    }
    clearTimeout(timer);
    timer = setTimeout(poll, 250);
  }

  async function ask(action, values) {
    const query = new URLSearchParams({ do: action, frame: state.data.frame, ...values });
    await fetch(`/humansim/photographs?${query}`).catch(() => {});
    timer = setTimeout(poll, 50);
  }

  // --- the panel -------------------------------------------------------------------------------------------
  function build() {
    element("style", {}, document.head).textContent = STYLE;
    panel = element("div", { id: "hs-photos" }, document.body);
    const bar = element("div", { class: "bar" }, panel);
    button("◀", "Previous point (P)", () => choose(state.point - 1), bar);
    chooser = element("select", { title: "Point that a click sets" }, bar);
    chooser.addEventListener("change", () => choose(chooser.selectedIndex));
    button("▶", "Next point (N)", () => choose(state.point + 1), bar);
    removeButton = button("Remove point", "Remove it from the framed photograph (Delete)", remove, bar);
    told = element("span", { class: "told" }, bar);
    grid = element("div", { class: "grid" }, panel);
    document.addEventListener("keydown", key);
    window.addEventListener("resize", () => state.data && show());
    poll();
  }

  function key(event) {
    if (!state.data || event.target.closest("input,textarea,select,[contenteditable]")) return;
    const command = event.ctrlKey || event.metaKey;
    if (command && event.key.toLowerCase() === "z") ask(event.shiftKey ? "redo" : "undo", {});
    else if (command && event.key.toLowerCase() === "y") ask("redo", {});
    else if (command) return;
    else if (event.key === "Delete" || event.key === "Backspace") remove();
    else if (event.key === "n") choose(state.point + 1);
    else if (event.key === "p") choose(state.point - 1);
    else return;
    event.preventDefault();
  }

  function choose(number, view) {
    const count = state.data.points.length;
    state.point = (number + count) % count;
    if (view !== undefined) state.view = view;
    show();
  }

  const chosenView = () => state.data.views.find((view) => view.name === state.view);

  function remove() {
    const view = chosenView();
    if (view && view.points[state.point])
      ask("remove", { view: view.name, point: state.data.points[state.point] });
  }

  function show() {
    const { data } = state;
    if (!chosenView()) state.view = data.views[0].name;
    if (chooser.options.length !== data.points.length)
      chooser.replaceChildren(...data.points.map(() => document.createElement("option")));
    data.points.forEach((name, number) => {
      const seen = data.views.filter((view) => view.points[number]).length;
      chooser.options[number].textContent = `${name} (in ${seen} of ${data.views.length})`;
    });
    chooser.selectedIndex = state.point;
    const view = chosenView();
    const residual = view.residuals[state.point];
    removeButton.disabled = !view.points[state.point];
    told.textContent = !view.points[state.point]
      ? `not in ${view.name}: click to set it`
      : `${view.name}: ${residual === null ? "no solution yet" : `${residual.toFixed(1)} px from the solution`}` +
        (view.outliers[state.point] ? ", left out" : "");
    for (const [name, known] of views)
      if (!data.views.some((each) => each.name === name)) {
        known.figure.remove();
        views.delete(name);
      }
    grid.style.setProperty("--columns", state.large || data.views.length === 1 ? 1 : data.views.length > 6 ? 3 : 2);
    for (const each of data.views) {
      if (!views.has(each.name)) views.set(each.name, figureOf(each));
      draw(views.get(each.name), each);
    }
  }

  // --- one photograph --------------------------------------------------------------------------------------
  function figureOf(view) {
    const figure = element("figure", {}, grid);
    const caption = element("figcaption", {}, figure);
    const title = element("b", {}, caption);
    const made = { figure, title, name: view.name, box: null, pointers: new Map(), last: null };
    button("⇄ sides", "Exchange left and right of this photograph", () => ask("exchange", { view: view.name }), caption);
    button("−", "Show all of it (or turn the wheel)", () => zoom(made, 1 / 1.5), caption);
    button("+", "Show it larger (or turn the wheel)", () => zoom(made, 1.5), caption);
    button("⤢", "This photograph only, or all", () => {
      state.large = state.large === view.name ? null : view.name;
      show();
    }, caption);
    made.svg = shape("svg", { "data-view": view.name }, figure);
    made.image = shape("image", { x: -0.5, y: -0.5, preserveAspectRatio: "none" }, made.svg);
    made.layer = shape("g", {}, made.svg);
    made.svg.addEventListener("pointerdown", (event) => down(made, event));
    made.svg.addEventListener("pointermove", (event) => move(made, event));
    made.svg.addEventListener("pointerup", (event) => up(made, event));
    made.svg.addEventListener("pointercancel", (event) => up(made, event));
    made.svg.addEventListener("contextmenu", (event) => {
      event.preventDefault();
      const number = numberAt(event);
      if (number !== null) ask("remove", { view: view.name, point: state.data.points[number] });
    });
    made.svg.addEventListener("wheel", (event) => {
      event.preventDefault();
      zoom(made, Math.exp(-event.deltaY / 400), placeOf(made, event));
    }, { passive: false });
    return made;
  }

  // The part of a photograph that is shown first: the person, by its points.
  function boxOf(view) {
    const points = view.points.filter((point) => point);
    if (points.length < 3) return [-0.5, -0.5, view.width, view.height];
    const ends = [0, 1].map((axis) => points.map((point) => point[axis]));
    const [across, along] = ends.map((values) => [Math.min(...values), Math.max(...values)]);
    const aspect = view.width / view.height;
    const height = 1.5 * Math.max(along[1] - along[0], (across[1] - across[0]) / aspect, view.height / 20);
    if (height > view.height) return [-0.5, -0.5, view.width, view.height];
    return within(view, [
      (across[0] + across[1] - height * aspect) / 2, (along[0] + along[1] - height) / 2, height * aspect, height,
    ]);
  }

  const within = (view, [left, top, width, height]) => [
    Math.min(Math.max(left, -0.5), view.width - width - 0.5),
    Math.min(Math.max(top, -0.5), view.height - height - 0.5),
    width,
    height,
  ];

  function draw(made, view) {
    made.view = view;
    made.figure.classList.toggle("chosen", view.name === state.view);
    made.figure.classList.toggle("large", view.name === state.large);
    made.figure.classList.toggle("hidden", state.large !== null && view.name !== state.large);
    const known = view.residuals.filter((value, number) => value !== null && !view.outliers[number]).sort((a, b) => a - b);
    made.title.textContent =
      view.name + (known.length ? ` · ${known[known.length >> 1].toFixed(1)} px` : "") + (view.exchanged ? " · sides were exchanged" : "");
    if (!made.box) made.box = boxOf(view);
    made.svg.setAttribute("viewBox", made.box.join(" "));
    made.svg.style.aspectRatio = `${view.width} / ${view.height}`;
    made.image.setAttribute("width", view.width);
    made.image.setAttribute("height", view.height);
    if (view.image) made.image.setAttribute("href", view.image);
    else made.image.removeAttribute("href");
    const pixel = made.box[2] / (made.svg.clientWidth || 300); // pixels of the photograph for one of the screen
    const layer = made.layer;
    layer.replaceChildren();
    const line = { fill: "none", "vector-effect": "non-scaling-stroke" };
    for (const points of view.outlines)
      if (points) shape("polygon", { ...line, points: points.join(" "), stroke: "#41e08a", "stroke-width": 1.6 }, layer);
    for (const bone of view.bones)
      if (bone)
        shape("line", { ...line, x1: bone[0], y1: bone[1], x2: bone[2], y2: bone[3], stroke: "#ffffff", "stroke-width": 1.2, opacity: 0.7 }, layer);
    const size = (state.large ? 12 : 9) * pixel;
    const labels = []; // names that would hide each other are told by the mouse, or in a larger view
    const order = view.points.map((_, number) => number).sort((a, b) => (b === state.point) - (a === state.point));
    order.forEach((number) => {
      const point = view.points[number];
      if (!point) return;
      const chosen = number === state.point;
      const colour = COLOURS[state.data.sides[number]];
      const fitted = view.fitted[number];
      if (fitted && !view.exchanged)
        shape("line", { ...line, x1: point[0], y1: point[1], x2: fitted[0], y2: fitted[1], stroke: colour, "stroke-width": 1.5, "stroke-dasharray": "3 2" }, layer);
      const group = shape("g", { class: "point", "data-number": number, transform: `translate(${point[0]} ${point[1]})` }, layer);
      shape("circle", { r: 11 * pixel, fill: "transparent" }, group);
      shape("circle", {
        r: (chosen ? 6 : 4) * pixel,
        fill: view.outliers[number] ? "transparent" : colour,
        "fill-opacity": 0.75,
        stroke: chosen ? "#ffffff" : view.outliers[number] ? colour : "#000000",
        "stroke-width": chosen ? 2 : 1,
        "vector-effect": "non-scaling-stroke",
      }, group);
      const residual = view.residuals[number];
      shape("title", {}, group).textContent =
        state.data.points[number] + (residual === null ? "" : `, ${residual.toFixed(1)} px`) + (view.outliers[number] ? ", left out" : "");
      const letters = chosen ? 1.3 * size : size;
      const label = [point[0] + 7 * pixel, point[1] - letters / 2, 0.6 * letters * state.data.points[number].length, letters];
      if (!chosen && labels.some((other) => overlap(label, other))) return;
      shape("text", { x: 7 * pixel, y: letters / 3, "font-size": letters }, group).textContent = state.data.points[number];
      labels.push(label);
    });
  }

  const overlap = (a, b) =>
    a[0] < b[0] + b[2] && b[0] < a[0] + a[2] && a[1] < b[1] + b[3] && b[1] < a[1] + a[3];

  // --- mouse and touch -------------------------------------------------------------------------------------
  let dragging = null;

  function placeOf(made, event) {
    const place = new DOMPoint(event.clientX, event.clientY).matrixTransform(made.svg.getScreenCTM().inverse());
    return [
      Math.min(Math.max(place.x, -0.5), made.view.width - 0.5),
      Math.min(Math.max(place.y, -0.5), made.view.height - 0.5),
    ];
  }

  function numberAt(event) {
    const group = event.target.closest(".point");
    return group ? Number(group.getAttribute("data-number")) : null;
  }

  function down(made, event) {
    if (event.button !== 0) return;
    made.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    if (made.pointers.size > 1) {
      dragging = null; // two fingers zoom
      return;
    }
    const number = numberAt(event);
    made.svg.setPointerCapture(event.pointerId);
    dragging = { made, number, from: [event.clientX, event.clientY], moved: false, box: made.box };
    if (number !== null) choose(number, made.name);
    else {
      state.view = made.name;
      show();
    }
  }

  function move(made, event) {
    if (!made.pointers.has(event.pointerId)) return;
    const before = [...made.pointers.values()];
    made.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    if (made.pointers.size > 1) {
      const distance = ([a, b]) => Math.hypot(a[0] - b[0], a[1] - b[1]);
      zoom(made, distance([...made.pointers.values()]) / Math.max(distance(before), 1), placeOf(made, event));
      return;
    }
    if (!dragging || dragging.made !== made) return;
    const across = event.clientX - dragging.from[0], along = event.clientY - dragging.from[1];
    if (Math.hypot(across, along) > 3) dragging.moved = true;
    if (!dragging.moved) return;
    if (dragging.number === null) {
      const pixel = dragging.box[2] / made.svg.clientWidth;
      pan(made, [dragging.box[0] - across * pixel, dragging.box[1] - along * pixel, dragging.box[2], dragging.box[3]]);
    } else {
      const [x, y] = placeOf(made, event);
      const group = made.layer.querySelector(`[data-number="${dragging.number}"]`);
      if (group) group.setAttribute("transform", `translate(${x} ${y})`);
    }
  }

  function up(made, event) {
    made.pointers.delete(event.pointerId);
    const done = dragging;
    dragging = null;
    if (!done || done.made !== made || event.type !== "pointerup") return;
    const number = done.number === null ? state.point : done.number;
    if (done.number === null ? done.moved : !done.moved) return; // the picture was moved, or a point was chosen
    const [x, y] = placeOf(made, event);
    ask("set", { view: made.name, point: state.data.points[number], x: x.toFixed(3), y: y.toFixed(3) });
  }

  function zoom(made, factor, place) {
    const [left, top, width, height] = made.box;
    const [x, y] = place || [left + width / 2, top + height / 2];
    const share = Math.min(Math.max(width / factor, made.view.width / 40), made.view.width) / width;
    pan(made, [x - (x - left) * share, y - (y - top) * share, width * share, height * share]);
  }

  function pan(made, box) {
    made.box = within(made.view, box);
    draw(made, made.view);
  }

  if (document.readyState === "loading") document.addEventListener("DOMContentLoaded", build);
  else build();
})();
