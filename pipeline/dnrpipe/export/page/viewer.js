// The neural view: WebGL2 draws what the network sees (G-buffer and baked light), onnxruntime-web runs the network.
// World axes are the .blend's (Z up); scene.glb is Y up: a point (x, y, z) there is (x, -z, y) here.
"use strict";

const SUPERSAMPLING = 4; // per side, for the coverage of silhouettes
const RECENT = 30; // frames over which times are averaged

const VERTEX = `#version 300 es
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec2 atlas;
uniform mat4 toClip;
uniform mat4 placed;
uniform mat3 placedNormal;
out vec3 worldPosition, worldNormal;
out vec2 place;
void main() {
  vec3 p = vec3(position.x, -position.z, position.y);
  vec4 world = placed * vec4(p, 1.0);
  worldPosition = world.xyz;
  worldNormal = placedNormal * vec3(normal.x, -normal.z, normal.y);
  place = vec2(atlas.x, 1.0 - atlas.y);
  gl_Position = toClip * world;
}`;

const SURFACE = `#version 300 es
precision highp float;
uniform sampler2D front, back;
uniform bool thin;
uniform vec3 eye;
in vec3 worldPosition, worldNormal;
in vec2 place;
layout(location = 0) out vec4 base;
layout(location = 1) out vec4 normal;
layout(location = 2) out vec4 uv;
void main() {
  vec4 lit = texture(front, place);
  if (lit.a < 0.5) discard;
  if (thin && !gl_FrontFacing) lit.rgb = texture(back, place).rgb;
  vec3 n = normalize(worldNormal);
  if (dot(n, eye - worldPosition) < 0.0) n = -n;
  base = vec4(lit.rgb, 1.0);
  normal = vec4(n, 1.0);
  uv = vec4(place, 0.0, 1.0);
}`;

const SILHOUETTE = `#version 300 es
precision highp float;
uniform sampler2D front;
in vec2 place;
in vec3 worldPosition, worldNormal;
out vec4 covered;
void main() {
  if (texture(front, place).a < 0.5) discard;
  covered = vec4(1.0);
}`;

const WHOLE = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0), 0.0, 1.0); }`;

const AVERAGE = `#version 300 es
precision highp float;
uniform sampler2D fine;
out vec4 mean;
void main() {
  ivec2 corner = ivec2(gl_FragCoord.xy) * ${SUPERSAMPLING};
  float sum = 0.0;
  for (int y = 0; y < ${SUPERSAMPLING}; y++)
    for (int x = 0; x < ${SUPERSAMPLING}; x++) sum += texelFetch(fine, corner + ivec2(x, y), 0).r;
  mean = vec4(sum / float(${SUPERSAMPLING * SUPERSAMPLING}));
}`;

// ---- files -------------------------------------------------------------------------------------------------------

const offline = location.protocol === "file:";

function bytesOf(text) {
  const raw = atob(text), bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  return bytes;
}

async function file(name) {
  if (offline) return bytesOf(window.DNR_OFFLINE.files[name]);
  const answer = await fetch(name);
  if (!answer.ok) throw new Error(`${name}: ${answer.status} ${answer.statusText}`);
  return new Uint8Array(await answer.arrayBuffer());
}

function script(name) {
  return new Promise((resolve, reject) => {
    const element = document.createElement("script");
    element.src = name;
    element.onload = resolve;
    element.onerror = () => reject(new Error(`${name} cannot be loaded`));
    document.head.append(element);
  });
}

// ---- meshes ------------------------------------------------------------------------------------------------------

function readGlb(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset);
  const length = view.getUint32(12, true);
  const document_ = JSON.parse(new TextDecoder().decode(bytes.subarray(20, 20 + length)));
  const body = bytes.subarray(28 + length);
  const content = (index) => {
    const accessor = document_.accessors[index], part = document_.bufferViews[accessor.bufferView];
    return { data: body.slice(part.byteOffset, part.byteOffset + part.byteLength), count: accessor.count };
  };
  const meshes = document_.meshes.map((mesh) => {
    const primitive = mesh.primitives[0], a = primitive.attributes;
    return {
      arrays: [content(a.POSITION), content(a.NORMAL), content(a.TEXCOORD_0)],
      indices: content(primitive.indices),
    };
  });
  return document_.nodes.map((node) => ({ mesh: meshes[node.mesh], matrix: node.matrix || null }));
}

// Column-major 4x4 from glTF's axes to ours: C M C^-1 with C (x, y, z) -> (x, -z, y).
function worldMatrix(m) {
  if (!m) return [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
  const at = (r, c) => m[c * 4 + r], from = [0, 2, 1, 3], sign = [1, -1, 1, 1], result = [];
  for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++) result.push(sign[r] * sign[c] * at(from[r], from[c]));
  return result;
}

// Inverse transpose of the upper 3x3, column-major: the matrix of cofactors, up to scale.
function normalMatrix(m) {
  const a = (r, c) => m[c * 4 + r], result = [];
  for (let c = 0; c < 3; c++)
    for (let r = 0; r < 3; r++) {
      const [i, j, k, l] = [(r + 1) % 3, (r + 2) % 3, (c + 1) % 3, (c + 2) % 3];
      result.push(a(i, k) * a(j, l) - a(i, l) * a(j, k));
    }
  const det = a(0, 0) * result[0] + a(1, 0) * result[1] + a(2, 0) * result[2];
  return result.map((value) => (det < 0 ? -value : value));
}

// ---- WebGL2 ------------------------------------------------------------------------------------------------------

class Raster {
  constructor(nodes, scene, front, back) {
    const canvas = document.createElement("canvas");
    const gl = canvas.getContext("webgl2", { antialias: false, depth: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("this browser has no WebGL2");
    if (!gl.getExtension("EXT_color_buffer_float")) throw new Error("WebGL2 here cannot draw into float textures");
    this.gl = gl;
    this.scene = scene;
    const info = gl.getExtension("WEBGL_debug_renderer_info");
    this.name = gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
    this.programs = {
      surface: this.program(VERTEX, SURFACE),
      silhouette: this.program(VERTEX, SILHOUETTE),
      average: this.program(WHOLE, AVERAGE),
    };
    this.front = this.light(front, scene.texels);
    this.back = scene.thin ? this.light(back, scene.texels) : this.front;
    const buffers = new Map();
    this.nodes = nodes.map(({ mesh, matrix }) => {
      if (!buffers.has(mesh)) buffers.set(mesh, this.vertices(mesh));
      const placed = worldMatrix(matrix);
      return { ...buffers.get(mesh), placed, normal: normalMatrix(placed) };
    });
    this.empty = gl.createVertexArray();
    this.size = "";
  }

  program(vertex, fragment) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    return program;
  }

  light(bytes, texels) {
    const gl = this.gl, texture = gl.createTexture();
    if (texels > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error(`textures of ${texels} texels are too large here`);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    const values = new Uint16Array(bytes.buffer, bytes.byteOffset, bytes.byteLength / 2);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, texels, texels, 0, gl.RGBA, gl.HALF_FLOAT, values);
    for (const [key, value] of [
      [gl.TEXTURE_MIN_FILTER, gl.LINEAR], [gl.TEXTURE_MAG_FILTER, gl.LINEAR],
      [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE],
    ]) gl.texParameteri(gl.TEXTURE_2D, key, value);
    return texture;
  }

  vertices(mesh) {
    const gl = this.gl, array = gl.createVertexArray();
    gl.bindVertexArray(array);
    mesh.arrays.forEach(({ data }, index) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(index);
      gl.vertexAttribPointer(index, index === 2 ? 2 : 3, gl.FLOAT, false, 0, 0);
    });
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, mesh.indices.data, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    return { array, count: mesh.indices.count };
  }

  target(width, height, formats, depth) {
    const gl = this.gl, buffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    const textures = formats.map((format, index) => {
      const texture = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + index, gl.TEXTURE_2D, texture, 0);
      return texture;
    });
    let depths = null;
    if (depth) {
      depths = gl.createRenderbuffer();
      gl.bindRenderbuffer(gl.RENDERBUFFER, depths);
      gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, width, height);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, depths);
    }
    gl.drawBuffers(formats.map((_, index) => gl.COLOR_ATTACHMENT0 + index));
    if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE)
      throw new Error("WebGL2 refused a float frame buffer");
    return { buffer, textures, depths, width, height };
  }

  resize(width, height) {
    if (this.size === `${width}x${height}`) return;
    const gl = this.gl;
    for (const old of [this.sharp, this.fine, this.coarse].filter(Boolean)) {
      old.textures.forEach((texture) => gl.deleteTexture(texture));
      gl.deleteRenderbuffer(old.depths);
      gl.deleteFramebuffer(old.buffer);
    }
    this.sharp = this.target(width, height, [gl.RGBA32F, gl.RGBA32F, gl.RGBA32F], true);
    this.fine = this.target(SUPERSAMPLING * width, SUPERSAMPLING * height, [gl.R8], true);
    this.coarse = this.target(width, height, [gl.RGBA32F], false);
    this.size = `${width}x${height}`;
  }

  draw(program, target, view) {
    const gl = this.gl, at = (name) => gl.getUniformLocation(program, name);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.viewport(0, 0, target.width, target.height);
    gl.enable(gl.DEPTH_TEST);
    target.textures.forEach((_, index) => gl.clearBufferfv(gl.COLOR, index, [0, 0, 0, 0]));
    gl.clearBufferfv(gl.DEPTH, 0, [1]);
    gl.useProgram(program);
    gl.uniformMatrix4fv(at("toClip"), false, clipMatrix(view, this.scene));
    gl.uniform3fv(at("eye"), [view.c2w[0][3], view.c2w[1][3], view.c2w[2][3]]);
    gl.uniform1i(at("thin"), this.scene.thin ? 1 : 0);
    [["front", this.front], ["back", this.back]].forEach(([name, texture], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(at(name), unit);
    });
    for (const node of this.nodes) {
      gl.uniformMatrix4fv(at("placed"), false, node.placed);
      gl.uniformMatrix3fv(at("placedNormal"), false, node.normal);
      gl.bindVertexArray(node.array);
      gl.drawElements(gl.TRIANGLES, node.count, gl.UNSIGNED_INT, 0);
    }
    gl.bindVertexArray(null);
  }

  // The network's inputs for a view, as Float32Arrays [C, H, W] by name, row 0 at the top.
  inputs(view) {
    const gl = this.gl, { width, height } = view;
    this.resize(width, height);
    this.draw(this.programs.surface, this.sharp, view);
    this.draw(this.programs.silhouette, this.fine, view);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.coarse.buffer);
    gl.viewport(0, 0, width, height);
    gl.disable(gl.DEPTH_TEST);
    gl.useProgram(this.programs.average);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.fine.textures[0]);
    gl.uniform1i(gl.getUniformLocation(this.programs.average, "fine"), 0);
    gl.bindVertexArray(this.empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    const [base, normal, uv, coverage] = [
      this.read(this.sharp, 0), this.read(this.sharp, 1), this.read(this.sharp, 2), this.read(this.coarse, 0),
    ];
    return {
      uv: planes(uv, width, height, [0, 1]),
      mask: planes(base, width, height, [3]),
      coverage: planes(coverage, width, height, [0]),
      view_dir: directions(view),
      normal: planes(normal, width, height, [0, 1, 2]),
      base: planes(base, width, height, [0, 1, 2, 3]),
    };
  }

  read(target, index) {
    const gl = this.gl, values = new Float32Array(4 * target.width * target.height);
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, target.buffer);
    gl.readBuffer(gl.COLOR_ATTACHMENT0 + index);
    gl.readPixels(0, 0, target.width, target.height, gl.RGBA, gl.FLOAT, values);
    return values;
  }
}

// Interleaved RGBA, bottom row first -> planes, top row first.
function planes(values, width, height, channels) {
  const result = new Float32Array(channels.length * width * height);
  channels.forEach((channel, plane) => {
    for (let y = 0; y < height; y++) {
      let from = 4 * width * (height - 1 - y) + channel, to = width * (plane * height + y);
      for (let x = 0; x < width; x++, from += 4) result[to++] = values[from];
    }
  });
  return result;
}

// Unit vectors from the surface to the camera: minus the ray through each pixel's centre.
function directions(view) {
  const { width, height, fl_x, fl_y, cx, cy, c2w } = view, count = width * height;
  const result = new Float32Array(3 * count);
  for (let y = 0, i = 0; y < height; y++)
    for (let x = 0; x < width; x++, i++) {
      const a = (x + 0.5 - cx) / fl_x, b = -(y + 0.5 - cy) / fl_y, length = Math.hypot(a, b, 1);
      for (let r = 0; r < 3; r++)
        result[r * count + i] = -(c2w[r][0] * a + c2w[r][1] * b - c2w[r][2]) / length;
    }
  return result;
}

// World -> clip space, column-major; OpenGL's camera axes, pixel (0, 0) at the top left.
function clipMatrix(view, scene) {
  const { width, height, fl_x, fl_y, cx, cy, c2w } = view;
  const eye = [0, 1, 2].map((r) => c2w[r][3]);
  const away = Math.hypot(...eye.map((value, i) => value - scene.center[i]));
  const far = away + 1.5 * scene.radius, near = Math.max(away - 1.5 * scene.radius, 0.003 * scene.radius);
  const camera = [0, 1, 2].map((axis) => {
    const row = [c2w[0][axis], c2w[1][axis], c2w[2][axis]];
    return [...row, -(row[0] * eye[0] + row[1] * eye[1] + row[2] * eye[2])];
  });
  camera.push([0, 0, 0, 1]);
  const lens = [
    [(2 * fl_x) / width, 0, 1 - (2 * cx) / width, 0],
    [0, (2 * fl_y) / height, (2 * cy) / height - 1, 0],
    [0, 0, -(far + near) / (far - near), (-2 * far * near) / (far - near)],
    [0, 0, -1, 0],
  ];
  const result = new Float32Array(16);
  for (let r = 0; r < 4; r++)
    for (let c = 0; c < 4; c++)
      for (let k = 0; k < 4; k++) result[c * 4 + r] += lens[r][k] * camera[k][c];
  return result;
}

// ---- network -----------------------------------------------------------------------------------------------------

const CHANNELS = { uv: 2, mask: 1, coverage: 1, view_dir: 3, normal: 3, base: 4 };

class Network {
  static async load() {
    const network = new Network();
    const model = await file("model.onnx");
    const adapter = !offline && navigator.gpu ? await navigator.gpu.requestAdapter().catch(() => null) : null;
    if (adapter) {
      try {
        await network.open(model, "webgpu", "ort-wasm-simd-threaded.asyncify.wasm");
        return network;
      } catch (error) {
        console.warn("WebGPU failed, WebAssembly instead:", error);
      }
    }
    await network.open(model, "wasm", "ort-wasm-simd-threaded.wasm");
    return network;
  }

  async open(model, provider, binary) {
    const base = new URL("ort/", location.href).href, bundle = `ort.${provider}.bundle.min.mjs`;
    let address = base + bundle;
    if (offline) address = URL.createObjectURL(new Blob([await file(`ort/${bundle}`)], { type: "text/javascript" }));
    this.ort = await import(address);
    const wasm = this.ort.env.wasm;
    wasm.numThreads = 1; // more need a server that isolates origins
    if (offline) wasm.wasmBinary = (await file(`ort/${binary}`)).buffer;
    else wasm.wasmPaths = { wasm: base + binary };
    this.session = await this.ort.InferenceSession.create(model, { executionProviders: [provider] });
    this.provider = provider === "webgpu" ? "WebGPU" : "WebAssembly, one thread";
  }

  // Display RGB over white, Float32Array [3, H, W].
  async run(inputs, width, height) {
    const feeds = {};
    for (const name of this.session.inputNames)
      feeds[name] = new this.ort.Tensor("float32", inputs[name], [1, CHANNELS[name], height, width]);
    const answer = await this.session.run(feeds, ["rgb"]);
    return answer.rgb.getData ? await answer.rgb.getData() : answer.rgb.data;
  }
}

// ---- page --------------------------------------------------------------------------------------------------------

const $ = (id) => document.getElementById(id);

class Page {
  constructor(scene, raster, network) {
    Object.assign(this, { scene, raster, network, times: [], dirty: true, busy: false });
    $("title").textContent = `${scene.name}: neural view`;
    const native = scene.size[0];
    for (const side of [...new Set([native / 2, native, native * 1.5, native * 2].map(Math.round))])
      $("size").add(new Option(`${side}²`, side, side === native, side === native));
    this.reset();
    for (const id of ["show", "size"]) $(id).onchange = () => this.touch(true);
    $("turn").onchange = () => this.touch(true);
    $("reset").onclick = () => this.reset();
    const canvas = $("picture");
    canvas.onpointerdown = (event) => canvas.setPointerCapture(event.pointerId);
    canvas.onpointermove = (event) => {
      if (!event.buttons) return;
      this.azimuth -= event.movementX * 0.01;
      this.elevation += event.movementY * 0.01;
      this.touch();
    };
    canvas.onwheel = (event) => {
      event.preventDefault();
      this.distance *= Math.exp(event.deltaY * 0.001);
      this.touch();
    };
    canvas.onkeydown = (event) => {
      const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
      if (!step) return;
      event.preventDefault();
      this.azimuth += step[0];
      this.elevation += step[1];
      this.touch();
    };
    requestAnimationFrame(() => this.loop());
  }

  reset() {
    const { start, center, distance } = this.scene, to = [0, 1, 2].map((i) => start.c2w[i][3] - center[i]);
    this.azimuth = Math.atan2(to[1], to[0]);
    this.elevation = Math.asin(to[2] / Math.hypot(...to));
    this.distance = distance;
    this.touch(true);
  }

  touch(fresh = false) {
    const limit = Math.PI / 2 - 0.02;
    this.elevation = Math.min(limit, Math.max(-limit, this.elevation));
    this.distance = Math.min(6 * this.scene.distance, Math.max(0.1 * this.scene.radius, this.distance));
    if (fresh) this.times = [];
    this.dirty = true;
  }

  view() {
    const { start, center, size } = this.scene, side = Number($("size").value), scale = side / size[0];
    const [ca, sa, ce, se] = [this.azimuth, this.elevation].flatMap((t) => [Math.cos(t), Math.sin(t)]);
    const back = [ca * ce, sa * ce, se], right = [-sa, ca, 0], up = [-ca * se, -sa * se, ce];
    const c2w = [0, 1, 2].map((r) => [right[r], up[r], back[r], center[r] + this.distance * back[r]]);
    return {
      width: side, height: Math.round(size[1] * scale), fl_x: start.fl_x * scale, fl_y: start.fl_y * scale,
      cx: side / 2, cy: Math.round(size[1] * scale) / 2, c2w: [...c2w, [0, 0, 0, 1]],
    };
  }

  async loop() {
    if ($("turn").checked) {
      this.azimuth += 0.02;
      this.dirty = true;
    }
    if (this.dirty && !this.busy && !this.probing) {
      this.dirty = false;
      await this.frame(this.view(), $("show").value);
    }
    requestAnimationFrame(() => this.loop());
  }

  async frame(view, show) {
    this.busy = true;
    try {
      const started = performance.now();
      const inputs = this.raster.inputs(view);
      const drawn = performance.now();
      const picture = show === "neural" ? await this.network.run(inputs, view.width, view.height) : plain(inputs, show);
      const ended = performance.now();
      this.paint(picture, view.width, view.height);
      this.times.push([drawn - started, ended - drawn, performance.now() - started, started]);
      if (this.times.length > RECENT) this.times.shift();
      this.report();
      $("message").textContent = "";
      return { inputs, picture };
    } catch (error) {
      fail(error);
      throw error;
    } finally {
      this.busy = false;
    }
  }

  paint(picture, width, height) {
    const canvas = $("picture"), count = width * height, image = new ImageData(width, height);
    for (let i = 0; i < count; i++) {
      for (let c = 0; c < 3; c++) image.data[4 * i + c] = 255 * picture[c * count + i] + 0.5;
      image.data[4 * i + 3] = 255;
    }
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    canvas.getContext("2d").putImageData(image, 0, 0);
  }

  // Milliseconds by stage and frames per second, both over the last frames; the latter only while frames follow.
  figures() {
    const mean = (k) => this.times.reduce((sum, time) => sum + time[k], 0) / this.times.length;
    const count = this.times.length - 1, whole = count < 1 ? 0 : this.times[count][3] - this.times[0][3];
    const steady = count >= 5 && whole / count < 2 * mean(2) + 50;
    return {
      raster_ms: mean(0), network_ms: mean(1), frame_ms: mean(2), fps: steady ? (1000 * count) / whole : null,
      frames: this.times.length, provider: this.network.provider, gl: this.raster.name,
    };
  }

  report() {
    const f = this.figures(), q = this.scene.quality;
    const rows = [
      ["frame", `${f.frame_ms.toFixed(1)} ms (drawing and reading back ${f.raster_ms.toFixed(1)}, network ` +
        `${f.network_ms.toFixed(1)}), mean of ${f.frames}`],
      ["frames per second", f.fps === null ? "measured while the camera moves" : f.fps.toFixed(1)],
      ["network runs on", f.provider],
      ["WebGL2", f.gl],
      ["quality", `${q.psnr.toFixed(1)} dB PSNR over ${q.test_views} ray-traced held-out views at ` +
        `${this.scene.size.join(" × ")}; baked light alone ${q.psnr_base.toFixed(1)} dB`],
    ];
    $("figures").replaceChildren(...rows.map((row) => {
      const line = document.createElement("tr");
      line.append(...row.map((text) => Object.assign(document.createElement("td"), { textContent: text })));
      return line;
    }));
  }

  // A frame of a given camera, for checks: inputs and picture as base64 of float32.
  async probe(view) {
    this.probing = true;
    while (this.busy) await new Promise((resolve) => setTimeout(resolve, 5));
    const { inputs, picture } = await this.frame(view, "neural");
    this.probing = false;
    const coded = (values) => {
      const bytes = new Uint8Array(values.buffer, values.byteOffset, values.byteLength);
      let text = "";
      for (let i = 0; i < bytes.length; i += 8192) text += String.fromCharCode(...bytes.subarray(i, i + 8192));
      return btoa(text);
    };
    const packed = Object.entries({ ...inputs, rgb: picture }).map(([name, values]) => [name, coded(values)]);
    return { ...Object.fromEntries(packed), figures: this.figures() };
  }
}

// Baked light (exposed plainly, not by the scene's display transform) or normals over white.
function plain(inputs, show) {
  const count = inputs.mask.length, picture = new Float32Array(3 * count);
  for (let i = 0; i < count; i++)
    for (let c = 0; c < 3; c++) {
      const value = show === "normal" ? 0.5 + 0.5 * inputs.normal[c * count + i]
        : Math.min(1, inputs.base[c * count + i]) ** (1 / 2.2);
      picture[c * count + i] = 1 + inputs.mask[i] * (value - 1);
    }
  return picture;
}

function fail(error) {
  $("message").textContent = `${error.message || error}`;
}

async function start() {
  if (offline) await script("offline.js");
  const scene = offline ? window.DNR_OFFLINE.scene : JSON.parse(new TextDecoder().decode(await file("scene.json")));
  const [mesh, front, back] = await Promise.all(["scene.glb", "light-front.bin", "light-back.bin"].map(file));
  const raster = new Raster(readGlb(mesh), scene, front, back);
  return new Page(scene, raster, await Network.load());
}

window.dnr = start();
window.dnr.catch(fail);
