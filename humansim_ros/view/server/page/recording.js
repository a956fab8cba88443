// Buttons at the scene, and pictures (PNG) and videos (MP4, or WebM where the browser has no H.264) of what is shown:
// the scene, the images beside it, and their labels (elements of the class humansim-label).
"use strict";
(() => {
  const page = window.humansim;
  const RATE = 30; // frames per second of a video
  const BITS = 8e6; // per second
  const KINDS = [
    ["video/mp4;codecs=avc1", "mp4"], // all players have it
    ["video/webm;codecs=vp8", "webm"], // the quickest of the others
    ["video/webm", "webm"],
  ];

  // --- buttons at the lower left corner of the scene ---------------------------------------------------------
  let bar = null;
  page.addTool = (text, title, use) => {
    const button = document.createElement("button");
    Object.assign(button.style, {
      font: "13px/1.5 system-ui, sans-serif",
      padding: "2px 9px",
      border: "1px solid #868e96",
      borderRadius: "4px",
      color: "#212529",
      background: "#fffd",
      cursor: "pointer",
    });
    button.textContent = text;
    button.title = title;
    button.addEventListener("click", () => {
      use(button);
      button.blur(); // keys of the page are not for the button
    });
    bar.append(button);
    return button;
  };

  function placeBar() {
    const canvas = document.querySelector("canvas");
    bar.style.display = canvas ? "flex" : "none";
    if (!canvas) return;
    const box = canvas.getBoundingClientRect();
    bar.style.left = `${box.left + 8}px`;
    bar.style.bottom = `${window.innerHeight - box.bottom + 8}px`;
  }

  // --- what is shown, as one canvas ---------------------------------------------------------------------------
  // Rectangle of the scene and the images beside it.
  function region() {
    const nodes = [document.querySelector("canvas"), document.querySelector("[data-humansim=tiles]")];
    const boxes = nodes.filter(Boolean).map((node) => node.getBoundingClientRect());
    const shown = boxes.filter((box) => box.width && box.height);
    const left = Math.min(...shown.map((box) => box.left));
    const top = Math.min(...shown.map((box) => box.top));
    const right = Math.max(...shown.map((box) => box.right));
    const bottom = Math.max(...shown.map((box) => box.bottom));
    return { left, top, width: right - left, height: bottom - top };
  }

  // An even number of pixels, as encoders want it, at the sharpness of the screen.
  function canvasFor({ width, height }) {
    const made = document.createElement("canvas");
    made.width = 2 * Math.max(1, Math.round((width * devicePixelRatio) / 2));
    made.height = 2 * Math.max(1, Math.round((height * devicePixelRatio) / 2));
    return made;
  }

  // Draw what is shown in the region, as large as the canvas lets it be.
  function paint(target) {
    const at = region();
    const context = target.getContext("2d");
    const scale = Math.min(target.width / at.width, target.height / at.height);
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.fillStyle = "#202020";
    context.fillRect(0, 0, target.width, target.height);
    context.setTransform(scale, 0, 0, scale, -scale * at.left, -scale * at.top);
    const scene = document.querySelector("canvas[data-engine]"); // of three.js; viser has another above it
    const box = scene.getBoundingClientRect();
    context.fillStyle = backgroundOf(scene);
    context.fillRect(box.left, box.top, box.width, box.height);
    context.drawImage(scene, box.left, box.top, box.width, box.height);
    const through = document.querySelector("[data-humansim=through]");
    if (through && through.tagName === "IMG") {
      context.fillStyle = "#000";
      context.fillRect(box.left, box.top, box.width, box.height);
    }
    for (const image of document.querySelectorAll("[data-humansim=tiles] img, img[data-humansim=through]")) {
      const place = image.getBoundingClientRect();
      if (place.width && image.complete && image.naturalWidth)
        context.drawImage(image, place.left, place.top, place.width, place.height);
    }
    for (const line of document.querySelectorAll("line.humansim-label")) drawLine(context, line);
    for (const label of document.querySelectorAll(".humansim-label:not(line)")) write(context, label);
  }

  function backgroundOf(node) {
    for (let at = node; at; at = at.parentElement) {
      const color = getComputedStyle(at).backgroundColor;
      if (color && color !== "rgba(0, 0, 0, 0)" && color !== "transparent") return color;
    }
    return "#fff";
  }

  function write(context, label) {
    const box = label.getBoundingClientRect();
    const style = getComputedStyle(label);
    if (!box.width || !label.textContent) return;
    context.fillStyle = style.backgroundColor;
    context.fillRect(box.left, box.top, box.width, box.height);
    context.fillStyle = style.color;
    context.font = `${style.fontSize} ${style.fontFamily}`;
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.fillText(label.textContent, box.left + box.width / 2, box.top + box.height / 2);
  }

  function drawLine(context, line) {
    const box = line.ownerSVGElement.getBoundingClientRect();
    const [x1, y1, x2, y2] = ["x1", "y1", "x2", "y2"].map((name) => Number(line.getAttribute(name)));
    context.strokeStyle = line.getAttribute("stroke");
    context.lineWidth = Number(line.getAttribute("stroke-width"));
    context.beginPath();
    context.moveTo(box.left + x1, box.top + y1);
    context.lineTo(box.left + x2, box.top + y2);
    context.stroke();
  }

  // --- files ------------------------------------------------------------------------------------------------------
  function save(blob, suffix) {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = `${document.title.split(" · ")[0].replace(/[^\w.-]+/g, "_") || "humansim"}_${page.frame ?? 0}.${suffix}`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
  }

  function takePicture() {
    const target = canvasFor(region());
    paint(target);
    target.toBlob((blob) => save(blob, "png"), "image/png");
  }

  let recorder = null;
  function toggleVideo(button) {
    if (recorder) {
      recorder.stop();
      return;
    }
    const kind = KINDS.find(([type]) => window.MediaRecorder && MediaRecorder.isTypeSupported(type));
    if (!kind) {
      button.textContent = "This browser records no video";
      button.disabled = true;
      return;
    }
    const target = canvasFor(region());
    paint(target);
    const parts = [];
    const made = new MediaRecorder(target.captureStream(RATE), { mimeType: kind[0], videoBitsPerSecond: BITS });
    const start = performance.now();
    let painted = 0;
    made.ondataavailable = (event) => event.data.size && parts.push(event.data);
    made.onerror = () => made.state !== "inactive" && made.stop();
    made.onstop = () => {
      recorder = null;
      button.textContent = "Record video";
      button.style.color = "#212529";
      save(new Blob(parts, { type: kind[0] }), kind[1]);
    };
    function next(now) {
      if (recorder !== made) return;
      requestAnimationFrame(next);
      if (now - painted < 900 / RATE) return;
      painted = now;
      paint(target);
      button.textContent = `Stop recording (${((performance.now() - start) / 1000).toFixed(0)} s)`;
    }
    recorder = made;
    button.style.color = "#c00";
    made.start(1000); // parts of a second
    requestAnimationFrame(next);
  }

  document.addEventListener("DOMContentLoaded", () => {
    bar = document.createElement("div");
    bar.setAttribute("role", "toolbar");
    bar.setAttribute("aria-label", "Tools of the scene");
    Object.assign(bar.style, { position: "fixed", zIndex: 7, gap: "6px" });
    document.body.append(bar);
    page.addTool("Picture", "Save what is shown as a PNG file", takePicture);
    page.addTool("Record video", "Record what is shown as a video", toggleVideo);
    setInterval(placeBar, 250);
    page.addEventListener("reserved", () => requestAnimationFrame(placeBar));
    placeBar();
  });
})();
