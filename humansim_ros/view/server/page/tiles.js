// The images of the cameras: tiles in an area of their own, left of the scene, or below it on a narrow page. They
// never cover the scene; a bar between them changes the sizes. A click in an image shows the numbers of the pixel,
// a click on its name (or two clicks in it) makes it large, in all tabs; the server then sends it in its full size.
"use strict";
(() => {
  const page = window.humansim;
  const BAR = 8; // thickness of the bar, pixels
  const GAP = 4;
  const PANEL = 330; // width of the panel at the right
  const LEAST = 120; // pixels that the scene keeps, at least
  const STRIP = 0.2; // share of the area for the others while one is large
  const SHARES = [0, 0.8]; // of the page, for the area
  let share = 0.4;
  let large = null; // "camera channel"
  let told = null; // the same, as the server has told it last
  let area = null;
  let bar = null;
  let note = null;
  const tiles = new Map(); // "camera channel": {figure, image, name, width, height}

  function element(kind, style, parent) {
    const made = document.createElement(kind);
    Object.assign(made.style, style);
    if (parent) parent.append(made);
    return made;
  }

  function build() {
    area = element("section", { position: "fixed", left: 0, background: "#202020", overflow: "hidden", display: "none" });
    area.setAttribute("aria-label", "Images");
    area.dataset.humansim = "tiles";
    bar = element("div", { position: "fixed", left: 0, background: "#868e96", display: "none", touchAction: "none" });
    bar.setAttribute("role", "separator");
    bar.setAttribute("aria-label", "Size of the images");
    bar.tabIndex = 0;
    bar.addEventListener("pointerdown", (event) => bar.setPointerCapture(event.pointerId));
    bar.addEventListener("pointermove", (event) => {
      if (bar.hasPointerCapture(event.pointerId)) drag(event.clientX, event.clientY);
    });
    bar.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: -1, ArrowRight: 1, ArrowUp: 1, ArrowDown: -1 }[event.key];
      if (step) change(share + 0.05 * step);
    });
    note = element("p", { color: "#ddd", font: "14px system-ui, sans-serif", margin: "1em" }, area);
    note.textContent = "The first images are being rendered.";
    document.body.append(area, bar);
    new ResizeObserver(place).observe(document.documentElement);
    page.addEventListener("reserved", place); // by another area
  }

  function change(wanted) {
    share = Math.min(Math.max(wanted, SHARES[0]), SHARES[1]);
    if (share < 0.03) share = 0; // closed: the bar stays
    place();
  }

  function drag(x, y) {
    const below = window.innerHeight - page.reservedByOthers("tiles", "Bottom");
    change((isBeside() ? x : below - y) / whole());
  }

  // Beside the scene on wide pages, else below it.
  const isBeside = () => window.innerWidth >= 1.2 * window.innerHeight;

  // Pixels that the area and the scene share.
  const whole = () =>
    isBeside() ? window.innerWidth - PANEL : window.innerHeight - page.reservedByOthers("tiles", "Bottom");

  function place() {
    const shown = Boolean(page.page && page.page.tiles);
    area.style.display = shown && share ? "block" : "none";
    bar.style.display = shown ? "block" : "none";
    const beside = isBeside();
    const size = Math.round(Math.min(share * whole(), whole() - LEAST));
    page.reserve("tiles", beside ? "Left" : "Bottom", shown ? size + BAR : 0);
    if (!shown) return;
    const under = page.reservedByOthers("tiles", "Bottom");
    const [width, height] = beside ? [size, window.innerHeight - under] : [window.innerWidth, size];
    Object.assign(area.style, { bottom: `${under}px`, width: `${width}px`, height: `${height}px` });
    Object.assign(bar.style, {
      left: beside ? `${size}px` : 0,
      bottom: `${beside ? under : under + size}px`,
      width: beside ? `${BAR}px` : "100%",
      height: beside ? `${height}px` : `${BAR}px`,
      cursor: beside ? "col-resize" : "row-resize",
    });
    bar.setAttribute("aria-orientation", beside ? "vertical" : "horizontal");
    bar.setAttribute("aria-valuenow", String(Math.round(100 * share)));
    arrange(width, height);
  }

  // Columns that make images of these shapes as large as possible together.
  function columnsFor(shapes, width, height) {
    let [best, found] = [0, 1];
    for (let columns = 1; columns <= shapes.length; columns += 1) {
      const [across, down] = [width / columns, height / Math.ceil(shapes.length / columns)];
      const sum = shapes.reduce((total, [w, h]) => total + Math.min(across / w, down / h) ** 2 * w * h, 0);
      if (sum > best) [best, found] = [sum, columns];
    }
    return found;
  }

  function grid(list, left, top, width, height) {
    const columns = columnsFor(list.map((tile) => [tile.width, tile.height]), width, height);
    const rows = Math.ceil(list.length / columns);
    const [across, down] = [width / columns, height / rows];
    list.forEach((tile, number) => {
      const scale = Math.min((across - GAP) / tile.width, (down - GAP) / tile.height);
      const [w, h] = [Math.max(scale * tile.width, 1), Math.max(scale * tile.height, 1)];
      Object.assign(tile.figure.style, {
        left: `${left + (number % columns) * across + (across - w) / 2}px`,
        top: `${top + Math.floor(number / columns) * down + (down - h) / 2}px`,
        width: `${w}px`,
        height: `${h}px`,
      });
    });
  }

  function arrange(width, height) {
    const list = [...tiles.values()];
    const chosen = tiles.get(large);
    const others = list.filter((tile) => tile !== chosen);
    if (!chosen || !others.length) grid(list, 0, 0, width, height);
    else {
      const strip = STRIP * Math.max(width, height);
      const below = height >= width;
      grid([chosen], 0, 0, below ? width : width - strip, below ? height - strip : height);
      if (below) grid(others, 0, height - strip, width, strip);
      else grid(others, width - strip, 0, strip, height);
    }
    for (const [key, tile] of tiles) tile.name.setAttribute("aria-pressed", String(key === large));
  }

  function toggle(key) {
    large = large === key ? null : key;
    const { camera, channel } = tiles.get(large) || { camera: "", channel: "" };
    fetch(`/humansim/enlarge?${new URLSearchParams({ camera, channel })}`).catch(() => {});
    place();
  }

  function makeTile(key, { camera, channel }) {
    const figure = element("figure", { position: "absolute", margin: 0 }, area);
    figure.dataset.humansim = key;
    const image = element("img", { width: "100%", height: "100%", display: "block", cursor: "crosshair" }, figure);
    image.alt = `${channel} image of ${camera}`;
    image.draggable = false;
    image.addEventListener("click", (event) => {
      const box = image.getBoundingClientRect();
      const across = ((event.clientX - box.left) / box.width).toFixed(6);
      const down = ((event.clientY - box.top) / box.height).toFixed(6);
      fetch(`/humansim/pick?${new URLSearchParams({ camera, across, down })}`).catch(() => {});
    });
    image.addEventListener("dblclick", () => toggle(key));
    const name = element("button", {
      position: "absolute",
      left: "3px",
      bottom: "3px",
      maxWidth: "calc(100% - 6px)",
      overflow: "hidden",
      padding: "1px 6px",
      border: 0,
      borderRadius: "4px",
      font: "13px/1.4 system-ui, sans-serif",
      color: "#fff",
      background: "#000a",
      cursor: "pointer",
    }, figure);
    name.className = "humansim-label";
    name.title = "Make this image large, or show all";
    name.addEventListener("click", () => toggle(key));
    const tile = { figure, image, name, camera, channel };
    tiles.set(key, tile);
    return tile;
  }

  function show(data) {
    const count = new DataView(data).getUint32(4, true);
    const table = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 8, count)));
    const several = new Set(table.map((entry) => entry.channel)).size > 1;
    const keys = table.map((entry) => `${entry.camera} ${entry.channel}`);
    for (const [key, tile] of tiles)
      if (!keys.includes(key)) {
        URL.revokeObjectURL(tile.image.src);
        tile.figure.remove();
        tiles.delete(key);
      }
    note.style.display = table.length ? "none" : "block";
    let at = 8 + count;
    let changed = false;
    table.forEach((entry, number) => {
      const tile = tiles.get(keys[number]) || makeTile(keys[number], entry);
      changed = changed || tile.width !== entry.width || tile.height !== entry.height;
      Object.assign(tile, { width: entry.width, height: entry.height });
      tile.name.textContent = several ? `${entry.camera}  ${entry.channel}` : entry.camera;
      const old = tile.image.src;
      tile.image.src = URL.createObjectURL(new Blob([new Uint8Array(data, at, entry.bytes)], { type: "image/jpeg" }));
      if (old) URL.revokeObjectURL(old);
      at += entry.bytes;
    });
    const order = keys.map((key) => [key, tiles.get(key)]);
    changed = changed || order.length !== tiles.size || keys.join() !== [...tiles.keys()].join();
    tiles.clear();
    for (const [key, tile] of order) tiles.set(key, tile);
    if (changed || area.dataset.count !== String(keys.length)) place();
    area.dataset.count = String(keys.length);
    awaitShown(table.length);
  }

  // Tell the server that the images are on the screen: it sends the newest ones then.
  let awaited = false;
  async function awaitShown(count) {
    await Promise.allSettled([...tiles.values()].map((tile) => tile.image.decode()));
    page.tellShown();
    if (awaited || !page.page || count < page.page.expected) return;
    awaited = true;
    requestAnimationFrame(() => setTimeout(() => page.dispatchEvent(new Event("shown"))));
  }

  document.addEventListener("DOMContentLoaded", () => {
    build();
    let latest = null;
    page.addEventListener("state", () => {
      const shown = Boolean(page.page.tiles);
      const key = page.page.large ? page.page.large.join(" ") : null;
      if (key !== told) large = key;
      if (shown !== latest || key !== told) place();
      [latest, told] = [shown, key];
    });
    page.addEventListener("images", (event) => show(event.data));
    place();
  });
})();
