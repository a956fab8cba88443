// Keys of the page, their help, names of its controls for screen readers, and what it says when its server has ended.
"use strict";
(() => {
  const page = window.humansim;
  const keys = {
    " ": ["play", "space: play or pause"],
    ArrowLeft: ["back", "← →: one frame back or on"],
    ArrowRight: ["on", ""],
    Home: ["first", "Home, End: first or last frame"],
    End: ["last", ""],
    "Ctrl+z": ["undo", "Ctrl-Z, Ctrl-Y: undo or redo an edit"],
    "Ctrl+y": ["redo", ""],
    Escape: ["escape", "Esc: end the measure tool, then clear the measures"],
    "?": ["help", "?: this list"],
  };
  const STYLE = {
    position: "fixed",
    zIndex: 1000,
    left: "50%",
    transform: "translateX(-50%)",
    padding: ".6em 1em",
    borderRadius: "6px",
    font: "15px/1.5 system-ui, sans-serif",
    color: "#fff",
    background: "#222e",
  };

  function box(text, style, role) {
    const made = document.createElement("div");
    Object.assign(made.style, STYLE, style);
    made.setAttribute("role", role);
    made.style.whiteSpace = "pre-line";
    made.textContent = text;
    document.body.append(made);
    return made;
  }

  let help = null;
  function toggleHelp() {
    if (help) {
      help.remove();
      help = null;
      return;
    }
    const lines = Object.values(keys).map(([, text]) => text);
    help = box(lines.filter(Boolean).join("\n"), { top: "20%" }, "dialog");
    help.setAttribute("aria-label", "Keys");
  }

  // What has the keys itself: fields, buttons, sliders, tabs and lists. Only the scene leaves them to the page.
  function isBusy(target) {
    return target.closest && target.closest("input, textarea, select, button, [role], [contenteditable]");
  }

  document.addEventListener(
    "keydown",
    (event) => {
      if (event.altKey || event.metaKey || isBusy(event.target)) return;
      const chosen = keys[`${event.ctrlKey ? "Ctrl+" : ""}${event.key}`];
      if (!chosen) return;
      const photographs = window.humansimPhotographs && window.humansimPhotographs.data;
      if (photographs && ["undo", "redo"].includes(chosen[0])) return; // photographs.js takes them back
      event.preventDefault();
      event.stopPropagation();
      if (chosen[0] === "help" || (chosen[0] === "escape" && help)) toggleHelp();
      else if (chosen[0] === "escape") page.dispatchEvent(new Event("escape"));
      else fetch(`/humansim/key?action=${chosen[0]}`).catch(() => {});
    },
    true,
  );

  // --- names for screen readers, where viser gives none --------------------------------------------------

  const unnamed = (node) => !node.getAttribute("aria-label") && !node.getAttribute("aria-labelledby");

  // Text of the label that stands beside a control.
  function labelOf(node) {
    for (let row = node.parentElement; row; row = row.parentElement) {
      const label = row.querySelector("label");
      if (label) return label.textContent.trim();
    }
    return "";
  }

  const NAMES = [
    ["#root canvas", () => "3D view of the scene"],
    [".mantine-Notification-closeButton", () => "Close the message"],
    [".mantine-Modal-close", () => "Close"],
    [".mantine-Slider-thumb, .mantine-ColorInput-input", labelOf],
    ["#root input, #root textarea", labelOf],
    ["#root button", (node) => (node.textContent.trim() ? "" : labelOf(node) || "Settings of the page")],
  ];

  setInterval(() => {
    for (const [selector, nameOf] of NAMES)
      for (const node of document.querySelectorAll(selector)) {
        const has = node.labels && node.labels.length;
        const name = unnamed(node) && !has ? nameOf(node) : "";
        if (name) node.setAttribute("aria-label", name);
      }
    const canvas = document.querySelector("#root canvas");
    if (canvas) canvas.setAttribute("role", "img");
    // pictures of buttons, which have names of their own
    for (const svg of document.querySelectorAll("#root svg:not([aria-hidden])")) svg.setAttribute("aria-hidden", "true");
  }, 700);

  let lost = null;
  page.addEventListener("lost", () => {
    const text = "The server of this page has ended, or cannot be reached. Start humansim view again.";
    lost = lost || box(text, { top: "1em", background: "#b00" }, "alert");
  });
  page.addEventListener("found", () => {
    if (lost) lost.remove();
    lost = null;
  });
})();
