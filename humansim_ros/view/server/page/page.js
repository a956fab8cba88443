// Our part of the page: textures of people (viser's skinned meshes have one colour), areas beside the scene, and a
// message where the browser has no WebGL. Loaded before viser's own script.
"use strict";
(() => {
  const scenes = new Set();

  // three.js reports its scenes to this target, made for developer tools (THREE.Scene, "observe").
  const tools = new EventTarget();
  window.__THREE_DEVTOOLS__ = tools;
  tools.addEventListener("observe", (event) => {
    if (event.detail && event.detail.isScene) scenes.add(event.detail);
  });

  // --- images first -----------------------------------------------------------------------------------------
  // Viser's own script keeps slow machines busy for seconds: it begins once the first images are shown, or when none
  // is expected or comes in time.
  const MOST = 3000; // milliseconds
  const held = [];
  let begun = false;
  const append = document.head.appendChild;
  document.head.appendChild = function (node) {
    if (begun || node.type !== "module") return append.call(this, node);
    held.push(node);
    return node;
  };
  function begin() {
    begun = true;
    for (const node of held.splice(0)) document.head.append(node);
  }
  setTimeout(begin, MOST);

  // --- textures ------------------------------------------------------------------------------------------
  // people.json: {key: {vertices, surface, texture}}. The key is the colour of the mesh, different for each.
  let people = {};
  let version = "";
  const surfaces = new Map();
  const textures = new Map();
  const shapes = new Map();
  const state = Object.assign(new EventTarget(), { textured: 0, people: 0, frame: null, page: null, cameras: {}, scenes });
  window.humansim = state;
  state.addEventListener("shown", begin); // all images (tiles.js)
  state.addEventListener("state", () => state.page.expected === 0 && begin());
  state.tableOf = (key) => people[key];

  async function loadPeople() {
    try {
      const answer = await fetch("/humansim/people.json");
      if (!answer.ok) return;
      const text = await answer.text();
      if (text === version) return;
      version = text;
      people = JSON.parse(text);
      surfaces.clear();
      textures.clear();
      shapes.clear();
      state.textured = 0;
    } catch (_) {
      // the server has ended; viser says so
    }
  }

  async function surfaceOf(url) {
    const answer = await fetch(url);
    if (!answer.ok) throw new Error(url); // of an earlier stage
    const data = await answer.arrayBuffer();
    const count = new Uint32Array(data, 0, 1)[0];
    return {
      normals: new Float32Array(data, 4, 3 * count),
      uv: new Float32Array(data, 4 + 12 * count, 2 * count),
    };
  }

  async function shapesOf(url) {
    const answer = await fetch(url);
    if (!answer.ok) throw new Error(url); // of an earlier stage
    const data = await answer.arrayBuffer();
    const [count, rows] = new Uint32Array(data, 0, 2);
    return {
      starts: new Uint32Array(data, 8, count + 1),
      rows: new Uint32Array(data, 12 + 4 * count, rows),
      offsets: new Float32Array(data, 12 + 4 * (count + rows), 3 * rows),
    };
  }

  function onceFor(cache, url, load) {
    if (!cache.has(url)) {
      const entry = { value: null };
      cache.set(url, entry);
      load(url).then((value) => (entry.value = value), () => cache.delete(url));
    }
    return cache.get(url).value;
  }

  async function imageOf(url) {
    const image = new Image();
    image.src = url;
    await image.decode();
    return image;
  }

  // A mesh is reused when its body changes: viser gives it the colour of the new body. White: it is dressed.
  function keyOf(mesh) {
    const color = mesh.material.color.getHexString();
    return color === "ffffff" ? mesh.userData.humansimKey : color;
  }

  function dress(mesh, key) {
    const material = mesh.material;
    const dressed = `${version} ${key} ${material.uuid} ${mesh.geometry.uuid}`;
    if (mesh.userData.humansimDressed === dressed) return;
    const person = people[key];
    const attributes = mesh.geometry.attributes;
    const surface = onceFor(surfaces, person.surface, surfaceOf);
    const image = person.texture ? onceFor(textures, person.texture, imageOf) : null;
    if (!surface || (person.texture && !image)) return;
    const Attribute = attributes.position.constructor;
    mesh.geometry.setAttribute("normal", new Attribute(surface.normals, 3));
    mesh.geometry.setAttribute("uv", new Attribute(surface.uv, 2));
    if (image) {
      // the class of textures: any that this page's three.js has made
      const Texture = textureClass();
      if (!Texture) return;
      const texture = new Texture(image);
      texture.colorSpace = "srgb";
      texture.anisotropy = 4;
      texture.needsUpdate = true;
      material.map = texture;
    } else material.map = null;
    // white times the texture; a person without one keeps its colour
    if (image) material.color.setHex(0xffffff);
    material.needsUpdate = true;
    mesh.userData.humansimKey = key;
    mesh.userData.humansimDressed = dressed;
    state.textured += 1;
  }

  let Found = null;
  function textureClass() {
    if (Found) return Found;
    for (const scene of scenes)
      scene.traverse((node) => {
        if (Found) return;
        // bone textures are DataTexture, a class made directly from Texture
        const bones = node.isSkinnedMesh && node.skeleton && node.skeleton.boneTexture;
        if (bones) Found = Object.getPrototypeOf(bones.constructor);
      });
    return Found;
  }

  function visit() {
    const found = new Map();
    for (const scene of scenes)
      scene.traverse((node) => {
        if (!node.isSkinnedMesh || !node.material || !node.material.color) return;
        const key = keyOf(node);
        if (!people[key] || node.geometry.attributes.position.count !== people[key].vertices) return;
        dress(node, key);
        if (!found.has(key)) found.set(key, []);
        found.get(key).push(node);
      });
    meshes = found;
    state.people = found.size;
    state.meshes = found;
  }
  setInterval(loadPeople, 1000);
  setInterval(visit, 200);
  loadPeople();

  // --- poses -----------------------------------------------------------------------------------------------
  // One message per frame: index, number of people; per person: key, numbers of bones, end points and weights, then for
  // each bone the quaternion x y z w and the position, the positions of the end points, and weights of the face; then
  // the centers of the cameras by name, as JSON. It replaces two messages of viser for each bone.
  let meshes = new Map();
  let poses = new Map();

  function readPoses(data) {
    const view = new DataView(data);
    const read = new Map();
    let at = 8;
    for (let person = view.getUint32(4, true); person > 0; person -= 1) {
      const key = view.getUint32(at, true).toString(16).padStart(6, "0");
      const [bones, ends, count] = new Uint32Array(data, at + 4, 3);
      const values = new Float32Array(data, at + 16, 7 * bones);
      const points = new Float32Array(data, at + 16 + 28 * bones, 3 * ends);
      const face = new Float32Array(data, at + 16 + 28 * bones + 12 * ends, count);
      read.set(key, { values, ends: points, face, reach: reachOf(values) });
      at += 16 + 28 * bones + 12 * ends + 4 * count;
    }
    poses = read;
    state.cameras = JSON.parse(new TextDecoder().decode(new Uint8Array(data, at)));
    state.frame = view.getUint32(0, true);
    state.received = (state.received || 0) + 1;
  }

  // Middle (3,) of the bones, and the largest distance of a bone from it.
  function reachOf(values) {
    const [middle, count] = [[0, 0, 0], values.length / 7];
    for (let i = 0; i < values.length; i += 7)
      for (let axis = 0; axis < 3; axis += 1) middle[axis] += values[i + 4 + axis] / count;
    let radius = 0;
    for (let i = 0; i < values.length; i += 7)
      radius = Math.max(radius, Math.hypot(...middle.map((value, axis) => values[i + 4 + axis] - value)));
    return { middle, radius };
  }

  // Keys of the people of the frame, and a joint (3,) of one in map: bones first, then end points; null without it.
  state.posed = () => poses.keys();
  state.jointOf = (key, number) => {
    const pose = poses.get(key);
    const bones = pose ? pose.values.length / 7 : 0;
    if (!pose || number >= bones + pose.ends.length / 3) return null;
    const [from, at] = number < bones ? [pose.values, 7 * number + 4] : [pose.ends, 3 * (number - bones)];
    return [...from.subarray(at, at + 3)];
  };

  // Move the vertices of a face at rest by its weights; normals stay.
  const moved = new WeakMap();
  function move(vertices, key, weights) {
    if (!weights.length && !moved.has(vertices)) return;
    const own = moved.get(vertices) || { rest: vertices.array.slice(), weights: new Float32Array(0) };
    const same = weights.length === own.weights.length && weights.every((weight, i) => weight === own.weights[i]);
    const url = people[key] && people[key].shapes;
    const found = same || !url ? null : onceFor(shapes, url, shapesOf);
    if (!found) return;
    vertices.array.set(own.rest);
    weights.forEach((weight, shape) => {
      if (weight === 0) return;
      for (let row = found.starts[shape]; row < found.starts[shape + 1]; row += 1)
        for (let axis = 0; axis < 3; axis += 1)
          vertices.array[3 * found.rows[row] + axis] += weight * found.offsets[3 * row + axis];
    });
    vertices.needsUpdate = true;
    moved.set(vertices, { rest: own.rest, weights });
  }

  function pose() {
    for (const [key, { values, face, reach }] of poses)
      for (const mesh of meshes.get(key) || []) {
        move(mesh.geometry.attributes.position, key, face);
        // always, as viser puts the bones of a new mesh at rest at a time of its own
        if (mesh.skeleton.bones.length !== values.length / 7) continue;
        // three.js tries a ray on a skinned mesh only in this sphere, and keeps the first it finds
        if (!mesh.boundingSphere) mesh.boundingSphere = mesh.geometry.boundingSphere.clone();
        mesh.boundingSphere.center.set(...reach.middle);
        mesh.boundingSphere.radius = reach.radius + mesh.geometry.boundingSphere.radius / 2;
        mesh.skeleton.bones.forEach((bone, number) => {
          const i = 7 * number;
          bone.quaternion.set(values[i], values[i + 1], values[i + 2], values[i + 3]);
          bone.position.set(values[i + 4], values[i + 5], values[i + 6]);
        });
      }
    requestAnimationFrame(pose);
  }
  requestAnimationFrame(pose);

  function listen() {
    const socket = new WebSocket(`ws://${location.host}/humansim/frames`);
    socket.binaryType = "arraybuffer";
    // text: the state of the page (JSON); bytes: poses, or images (tiles.js)
    socket.onmessage = (event) => {
      if (typeof event.data !== "string") {
        const images = new DataView(event.data).getUint32(0, true) === 0xffffffff;
        return images ? state.dispatchEvent(new MessageEvent("images", { data: event.data })) : readPoses(event.data);
      }
      state.page = JSON.parse(event.data);
      state.dispatchEvent(new Event("state"));
    };
    state.tellShown = () => socket.readyState === WebSocket.OPEN && socket.send("shown"); // the latest images
    socket.onopen = () => state.dispatchEvent(new Event("found"));
    socket.onclose = () => {
      state.dispatchEvent(new Event("lost"));
      setTimeout(listen, 1000);
    };
  }
  listen();

  // --- areas beside the scene ------------------------------------------------------------------------------
  // Keep pixels of a side of the page (Left, Bottom …) free from the scene and its panels for an area.
  const kept = {};
  state.reserve = (area, side, pixels) => {
    if (String(kept[area]) === String([side, pixels])) return;
    kept[area] = [side, pixels];
    const sums = { Left: 0, Bottom: 0 };
    for (const [at, count] of Object.values(kept)) sums[at] += count;
    document.body.style.boxSizing = "border-box";
    for (const [at, count] of Object.entries(sums)) document.body.style[`padding${at}`] = `${count}px`;
    state.dispatchEvent(new Event("reserved"));
  };
  // Pixels of a side that other areas have.
  state.reservedByOthers = (area, side) =>
    Object.entries(kept).reduce((sum, [name, [at, count]]) => sum + (name !== area && at === side ? count : 0), 0);

  // --- panel -----------------------------------------------------------------------------------------------
  // Viser's scroll bars lie over the panel: its rows end beside them.
  const style = document.createElement("style");
  style.textContent = `.mantine-ScrollArea-root:has(> .mantine-ScrollArea-scrollbar[data-orientation="vertical"])
    > .mantine-ScrollArea-viewport > .mantine-ScrollArea-content { padding-right: 6px; }`;
  append.call(document.head, style);

  // --- no WebGL --------------------------------------------------------------------------------------------
  function hasWebGL() {
    try {
      const canvas = document.createElement("canvas");
      return Boolean(canvas.getContext("webgl2"));
    } catch (_) {
      return false;
    }
  }
  if (!hasWebGL())
    document.addEventListener("DOMContentLoaded", () => {
      document.body.innerHTML =
        '<div style="font:16px/1.5 system-ui,sans-serif;max-width:34em;margin:15vh auto;padding:0 1em">' +
        "<h1>This browser has no WebGL 2</h1><p>The 3D page needs it. Turn on hardware acceleration (or " +
        "software rendering) in the settings of the browser, or use another browser. Without a browser, " +
        "<code>humansim snapshot SCENE -o sheet.png</code> draws the scene into a picture.</p></div>";
      document.body.dataset.humansim = "no-webgl";
    });
})();
