/* The live viewer: a camera that the mouse moves; the server sends pictures. One request is under way at a time. */
"use strict";
(function () {
  const $ = function (id) { return document.getElementById(id); };
  const NAMES = { neural: "neural", base: "base image", reference: "path-traced (gets better)", error: "error (FLIP)", nearest: "nearest training view" };
  const STEEPEST = 89 * Math.PI / 180, SETTLED = 150;
  const name = new URLSearchParams(location.search).get("w") || "";
  const canvas = $("picture");
  let socket = null, hello = null, camera = null, waiting = false, wanted = false, moving = false, timer = null, mode = "neural", frames = [];
  let refused = false, tries = 0;
  const TRIES = 8;
  $("title").textContent = name;

  function problem(text) { $("problem-text").textContent = text; $("problem").hidden = !text; }
  /* Nothing is tried again by itself after a refusal. */
  function stop(text) { problem(text); $("again").hidden = false; $("status").textContent = "not connected"; }
  $("again").addEventListener("click", function () { $("again").hidden = true; problem(""); tries = 0; start(); });
  document.addEventListener("token-wanted", function () { $("token-form").hidden = false; $("token").focus(); });
  $("token-form").addEventListener("submit", function (event) {
    event.preventDefault();
    api.setToken($("token").value.trim());
    $("token").value = ""; $("token-form").hidden = true;
    problem(""); $("again").hidden = true;
    start();
  });
  /* Asked over HTTP first: a socket does not say why it was refused. */
  async function start() {
    $("status").textContent = "connecting";
    try {
      await api.get("/workspaces/" + encodeURIComponent(name));
    } catch (error) {
      if (error.status) stop(error.message); else again(error.message);
      return;
    }
    connect();
  }
  function again(text) {
    tries += 1;
    if (tries > TRIES) { stop(text || "The connection was lost."); return; }
    $("status").textContent = "not connected; trying again";
    setTimeout(start, Math.min(30000, 1000 * Math.pow(2, tries - 1)));
  }
  /* Pixels of the picture at rest: as many as the window shows, in steps that the network takes. */
  function pixels() {
    if ($("size").value !== "window") return Number($("size").value);
    return Math.max(128, Math.min(512, 32 * Math.round(canvas.clientWidth * (window.devicePixelRatio || 1) / 32)));
  }
  /* What takes longer than a second is said: the first frame of a mode and size compiles kernels. */
  let asked = 0;
  setInterval(function () {
    const seconds = Math.floor((performance.now() - asked) / 1000);
    if (waiting && seconds >= 1) $("status").textContent = (canvas.dataset.frames ? "waiting for a frame" : "loading the scene, compiling its kernels") + ": " + seconds + " s";
  }, 500);
  function home() {
    camera = { azimuth: -Math.PI / 3, elevation: 0.44, distance: hello.distance, target: hello.center.slice() };
    ask(false);
    trace();
  }
  function ask(inMotion) {
    moving = inMotion;
    if (!hello || socket.readyState !== WebSocket.OPEN) return;
    if (waiting) { wanted = true; return; }
    waiting = true; wanted = false; asked = performance.now();
    socket.send(JSON.stringify({ camera: camera, size: pixels(), mode: mode, moving: moving }));
  }
  function moved() {
    camera.elevation = Math.max(-STEEPEST, Math.min(STEEPEST, camera.elevation));
    clearTimeout(timer);
    timer = setTimeout(function () { ask(false); trace(); }, SETTLED);
    ask(true);
    if (tracer) { tracer.close(); tracer = null; $("reference-caption").textContent = "waits for the camera to rest"; }
  }

  function connect() {
    refused = false;
    socket = api.socket("/workspaces/" + encodeURIComponent(name) + "/live");
    socket.binaryType = "arraybuffer";
    socket.onmessage = function (event) {
      if (typeof event.data === "string") {
        const told = JSON.parse(event.data);
        if (told.kind === "hello") {
          hello = told; tries = 0; problem(""); $("status").textContent = "loading the scene, compiling its kernels";
          choices();
          if (camera) ask(false); else home();
        } else { waiting = false; refused = !hello; problem(told.detail); $("status").textContent = ""; }
        return;
      }
      waiting = false;
      problem("");
      show(event.data);
      if (wanted) ask(moving);
    };
    socket.onclose = function () {
      waiting = false;
      if (refused) stop($("problem-text").textContent); else again("");
    };
  }
  async function draw(message, onto) {
    const length = new DataView(message).getUint32(0, true);
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(message, 4, length)));
    const picture = await createImageBitmap(new Blob([new Uint8Array(message, 4 + length)], { type: header.type }));
    if (onto.width !== picture.width) { onto.width = picture.width; onto.height = picture.height; }
    onto.getContext("2d").drawImage(picture, 0, 0);
    picture.close();
    return header;
  }

  /* The path-traced picture beside it has a socket of its own, open while the camera rests: the server adds samples. */
  let tracer = null, traced = 0;
  function trace() {
    if (tracer) tracer.close();
    tracer = null;
    $("beside-stage").hidden = !$("beside").checked;
    if (!$("beside").checked || !camera || moving) return;
    const mine = tracer = api.socket("/workspaces/" + encodeURIComponent(name) + "/live");
    mine.binaryType = "arraybuffer"; traced = 0;
    mine.onmessage = async function (event) {
      if (mine !== tracer) return;
      if (typeof event.data === "string") {
        const told = JSON.parse(event.data);
        if (told.kind === "hello") mine.send(JSON.stringify({ camera: camera, size: pixels(), mode: "reference", moving: false }));
        else $("reference-caption").textContent = told.detail;
        return;
      }
      const header = await draw(event.data, $("reference"));
      traced += (header.ms["path tracing"] || 0);
      $("reference-caption").textContent = "path-traced, " + header.spp + " samples a pixel, " + Math.round(traced) + " ms";
      $("reference").dataset.spp = header.spp;
    };
  }
  $("beside").addEventListener("change", function () { trace(); if (camera) ask(false); });

  async function show(message) {
    const header = await draw(message, canvas);
    canvas.dataset.frames = Number(canvas.dataset.frames || 0) + 1;
    canvas.dataset.fine = header.moving ? "" : "yes";
    canvas.dataset.mode = header.mode;
    const now = performance.now();
    frames = frames.filter(function (t) { return now - t < 2000; }).concat(now);
    const pace = frames.length > 1 ? (frames.length - 1) / (now - frames[0]) * 1000 : 0;
    const rays = header.moving ? header.samples : header.rays;
    $("status").textContent = header.width + "²" + (rays ? ", " + rays + " rays" : "") + (header.spp ? ", " + header.spp + " spp" : "") +
      (header.moving ? ", " + pace.toFixed(1) + " frames/s" : ", full quality") + (header.nearest ? " · nearest training view " + header.nearest : "") +
      (header.repaired ? " · repaired: " + header.repaired + " pixels that were not finite" : "");
    const waited = header.waited_ms >= 1 ? [["waiting for " + (header.viewers > 1 ? "others (" + header.viewers + " views open)" : "the frame before"), header.waited_ms]] : [];
    const rows = Object.entries(header.ms).concat(waited, [["altogether", header.total_ms]]).map(function (entry) {
      const row = document.createElement("tr"), head = document.createElement("th"), value = document.createElement("td");
      head.textContent = entry[0]; value.textContent = entry[1].toFixed(1) + " ms";
      row.append(head, value);
      return row;
    });
    $("times").tBodies[0].replaceChildren.apply($("times").tBodies[0], rows);
  }
  function choices() {
    if ($("modes").querySelector("input")) return;
    hello.modes.forEach(function (key) {
      const label = document.createElement("label"), input = document.createElement("input");
      input.type = "radio"; input.name = "mode"; input.value = key; input.checked = key === mode;
      input.addEventListener("change", function () { mode = key; ask(false); });
      label.append(input, " " + (NAMES[key] || key));
      $("modes").append(label);
    });
  }

  function pan(dx, dy) {
    const a = camera.azimuth, e = camera.elevation, step = camera.distance / canvas.clientHeight;
    const right = [-Math.sin(a), Math.cos(a), 0], up = [-Math.sin(e) * Math.cos(a), -Math.sin(e) * Math.sin(a), Math.cos(e)];
    camera.target = camera.target.map(function (t, i) { return t + step * (up[i] * dy - right[i] * dx); });
  }
  let drag = null;
  canvas.addEventListener("contextmenu", function (event) { event.preventDefault(); });
  canvas.addEventListener("pointerdown", function (event) {
    if (!camera) return;
    drag = { x: event.clientX, y: event.clientY, pan: event.button !== 0 || event.shiftKey };
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", function (event) {
    if (!drag) return;
    const dx = event.clientX - drag.x, dy = event.clientY - drag.y;
    drag.x = event.clientX; drag.y = event.clientY;
    if (drag.pan) pan(dx, dy);
    else { camera.azimuth -= dx * 0.008; camera.elevation += dy * 0.008; }
    moved();
  });
  ["pointerup", "pointercancel"].forEach(function (kind) { canvas.addEventListener(kind, function () { drag = null; }); });
  canvas.addEventListener("wheel", function (event) {
    event.preventDefault();
    if (!camera) return;
    camera.distance = Math.max(0.05 * hello.radius, Math.min(50 * hello.radius, camera.distance * Math.exp(event.deltaY * 0.001)));
    moved();
  }, { passive: false });
  canvas.addEventListener("keydown", function (event) {
    if (!camera) return;
    const keys = { ArrowLeft: [0.06, 0, 1], ArrowRight: [-0.06, 0, 1], ArrowUp: [0, 0.06, 1], ArrowDown: [0, -0.06, 1], "+": [0, 0, 0.95], "-": [0, 0, 1.05] };
    const found = keys[event.key];
    if (!found) return;
    event.preventDefault();
    camera.azimuth += found[0]; camera.elevation += found[1]; camera.distance *= found[2];
    moved();
  });
  $("home").addEventListener("click", home);
  $("size").addEventListener("change", function () { ask(false); });
  window.addEventListener("resize", function () { if (camera && $("size").value === "window") moved(); });
  start();
})();
