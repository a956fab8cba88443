// Files that are chosen to be sent: a file that the server would refuse is told at once, and not sent.
"use strict";
(() => {
  const most = Number(document.currentScript.dataset.most); // bytes
  // before the page's own listener, which sends the file
  document.addEventListener(
    "change",
    (event) => {
      const input = event.target;
      if (!(input instanceof HTMLInputElement) || input.type !== "file") return;
      const wrong = [...input.files].find((file) => file.size > most || file.size === 0);
      if (!wrong) return;
      event.stopImmediatePropagation();
      input.value = "";
      const query = new URLSearchParams({ name: wrong.name.slice(0, 200), size: String(wrong.size) });
      fetch(`/humansim/refused?${query}`).catch(() => {});
    },
    true,
  );
})();
