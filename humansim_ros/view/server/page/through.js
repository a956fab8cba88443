// The view through a camera. One rectangle of the page, with the shape of the image, is used for the image, for
// the projection of the 3D view (with the principal point of the camera), for clicks and for names.
"use strict";
(() => {
  const page = window.humansim;
  let cover = null;
  let picture = null;
  let lens = null; // what the projection of the 3D view is made for

  // Rectangle of an image of a size in the canvas: as large as possible, in the middle. Pixels of the page.
  function rectangle(size) {
    const box = document.querySelector("canvas").getBoundingClientRect();
    const scale = Math.min(box.width / size[0], box.height / size[1]);
    const [width, height] = [scale * size[0], scale * size[1]];
    const [left, top] = [box.left + (box.width - width) / 2, box.top + (box.height - height) / 2];
    return { left, top, width, height, scale, box };
  }
  page.rectangle = rectangle;

  function element(kind, style) {
    const made = document.createElement(kind);
    Object.assign(made.style, { position: "fixed", zIndex: 5 }, style);
    document.body.append(made);
    return made;
  }

  function place(made, { left, top, width, height }) {
    Object.assign(made.style, { left: `${left}px`, top: `${top}px`, width: `${width}px`, height: `${height}px` });
  }

  function click(event) {
    event.stopPropagation(); // not a click in the images beside the scene
    const box = picture.getBoundingClientRect();
    const across = (event.clientX - box.left) / box.width;
    const down = (event.clientY - box.top) / box.height;
    fetch(`/humansim/through?across=${across.toFixed(6)}&down=${down.toFixed(6)}`).catch(() => {});
  }

  function draw() {
    requestAnimationFrame(draw);
    const through = page.page && page.page.through;
    lens = through && !through.lens ? through : null;
    if (!through || !document.querySelector("canvas")) {
      for (const made of [cover, picture]) if (made) made.remove();
      cover = picture = null;
      return;
    }
    const at = rectangle(through.size);
    if (!cover) {
      cover = element("div", {});
      picture = element(through.lens ? "img" : "div", {});
      picture.dataset.humansim = "through";
      if (through.lens) picture.alt = `image of ${through.camera}`;
      picture.addEventListener("click", click);
    }
    if ((picture.tagName === "IMG") !== through.lens) {
      cover.remove();
      picture.remove();
      cover = picture = null;
      return;
    }
    place(cover, at.box);
    place(picture, at);
    cover.style.background = through.lens ? "#000" : "none";
    cover.style.pointerEvents = through.lens ? "auto" : "none";
    if (!through.lens) {
      Object.assign(picture.style, { outline: "9999px solid #0006", pointerEvents: "none" });
      cover.style.clipPath = "inset(0)";
      if (picture.parentNode !== cover) cover.append(picture);
      return;
    }
    if (through.image && picture.getAttribute("src") !== through.image) picture.src = through.image;
    cover.replaceChildren(
      ...through.names.map(([name, across, down]) => {
        const label = document.createElement("span");
        label.textContent = name;
        label.className = "humansim-label";
        Object.assign(label.style, {
          position: "fixed",
          zIndex: 6,
          left: `${at.left + across * at.width}px`,
          top: `${at.top + down * at.height}px`,
          transform: "translate(-50%, -50%)",
          font: "14px system-ui, sans-serif",
          background: "#fffb",
          padding: "0 .3em",
          pointerEvents: "none",
        });
        return label;
      }),
    );
  }
  requestAnimationFrame(draw);

  // The projection of the 3D view, for all that asks for it: pixels of the page as pixels of the camera.
  function adjust(camera) {
    if (!lens) return;
    const { left, top, scale, box } = rectangle(lens.size);
    const [fx, fy, cx, cy] = lens.K;
    const across = left - box.left + scale * (cx + 0.5);
    const down = top - box.top + scale * (cy + 0.5);
    const e = camera.projectionMatrix.elements;
    e[0] = (2 * scale * fx) / box.width;
    e[5] = (2 * scale * fy) / box.height;
    e[8] = 1 - (2 * across) / box.width;
    e[9] = (2 * down) / box.height - 1;
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  }

  function beforeRender(_, scene, camera) {
    if (!camera.isPerspectiveCamera) return;
    if (!camera.humansimOwn) {
      camera.humansimOwn = camera.updateProjectionMatrix;
      camera.updateProjectionMatrix = function () {
        camera.humansimOwn.call(this);
        adjust(this);
      };
    }
    camera.updateProjectionMatrix();
    page.camera = camera;
    page.scene = scene;
  }
  setInterval(() => {
    for (const scene of page.scenes) scene.onBeforeRender = beforeRender;
  }, 500);
})();
