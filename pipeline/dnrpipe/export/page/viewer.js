// The neural view: WebGL2 draws what the network sees (G-buffer and baked light), onnxruntime-web runs the network.
// World axes are the .blend's: right-handed, Z up.
"use strict";

const FINER = 3; // samples along a pixel's side; odd: the middle one is what the pixel shows, all are its coverage
const MEASURED = 8; // frames that are drawn after a change, so that frames a second are known while nothing moves
const RECENT = 30; // frames over which times are averaged

const VERTEX = `#version 300 es
layout(location = 0) in vec3 position; // of the mesh's box, 0 to 1
layout(location = 1) in vec3 normal; // of any length
layout(location = 2) in vec2 atlas;
uniform mat4 toClip;
uniform mat3 placedNormal;
out vec3 worldNormal;
out vec2 place;
void main() {
  worldNormal = placedNormal * normal;
  place = atlas;
  gl_Position = toClip * vec4(position, 1.0);
}`;

// Samples are many, so they are small: place in the atlas, 16 bits each; normal, 10 bits each; 1: a front is seen, 2: a
// back, 0: nothing. A shader that may discard tests depth late, so it says so only where the scene has cut-outs.
const SAMPLE = (cutouts) => `#version 300 es
precision highp float;
uniform sampler2D front;
in vec3 worldNormal;
in vec2 place;
out uvec2 seen;
void main() {
  ${cutouts ? "if (texture(front, place).a < 0.5) discard;" : ""}
  uvec3 n = uvec3(512.0 + 511.0 * normalize(worldNormal) + 0.5);
  seen = uvec2(packUnorm2x16(place), n.x | n.y << 10 | n.z << 20 | (gl_FrontFacing ? 1u : 2u) << 30);
}`;

const WHOLE = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0), 0.0, 1.0); }`;

const PIXEL = `#version 300 es
precision highp float;
uniform highp usampler2D samples;
uniform sampler2D front, back; // radiance as log(1 + curve · x) over range
uniform float curve, range;
layout(location = 0) out vec4 base; // and whether there is a surface
layout(location = 1) out vec4 normal; // and coverage
layout(location = 2) out vec4 uv;
void main() {
  ivec2 corner = ${FINER} * ivec2(gl_FragCoord.xy);
  float covered = 0.0;
  for (int y = 0; y < ${FINER}; y++)
    for (int x = 0; x < ${FINER}; x++) covered += texelFetch(samples, corner + ivec2(x, y), 0).y == 0u ? 0.0 : 1.0;
  covered /= ${FINER * FINER}.0;
  base = uv = vec4(0.0);
  normal = vec4(0.0, 0.0, 0.0, covered);
  uvec4 seen = texelFetch(samples, corner + ${(FINER - 1) / 2}, 0);
  if (seen.y == 0u) return;
  vec2 place = unpackUnorm2x16(seen.x);
  vec3 code = seen.y >> 30 == 2u ? textureLod(back, place, 0.0).rgb : textureLod(front, place, 0.0).rgb;
  base = vec4((exp(range * code) - 1.0) / curve, 1.0);
  normal.xyz = normalize(vec3(uvec3(seen.y, seen.y >> 10, seen.y >> 20) & 1023u) - 512.0);
  uv = vec4(place, 0.0, 1.0);
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

// NAME.gz, unpacked. Some servers announce it as compressed; then the browser has unpacked it already.
async function unpacked(name) {
  const bytes = await file(`${name}.gz`);
  if (bytes[0] !== 0x1f || bytes[1] !== 0x8b) return bytes;
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

async function picture(name) {
  const blob = new Blob([await file(name)], { type: "image/webp" });
  return createImageBitmap(blob, { premultiplyAlpha: "none", colorSpaceConversion: "none" });
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

// The arrays of each mesh, as page_data.py packs them; indices are differences, which compress better.
function readMeshes(bytes, meshes) {
  let at = bytes.byteOffset;
  const take = (Kind, count) => {
    const values = new Kind(bytes.buffer, at, count);
    at += values.byteLength;
    return values;
  };
  return meshes.map(({ vertices, triangles, ...mesh }) => {
    const indices = take(Int32Array, 3 * triangles);
    for (let i = 1; i < indices.length; i++) indices[i] += indices[i - 1];
    const [positions, normals] = [take(Uint16Array, 3 * vertices), take(Int16Array, 3 * vertices)];
    return { ...mesh, indices, positions, normals, atlas: take(Uint16Array, 2 * vertices) };
  });
}

// Matrices are 4x4, column-major.
function product(a, b) {
  const result = new Array(16).fill(0);
  for (let c = 0; c < 4; c++)
    for (let r = 0; r < 4; r++) for (let k = 0; k < 4; k++) result[c * 4 + r] += a[k * 4 + r] * b[c * 4 + k];
  return result;
}

// The unit cube -> a mesh's box.
function boxMatrix(low, extent) {
  return [extent[0], 0, 0, 0, 0, extent[1], 0, 0, 0, 0, extent[2], 0, ...low, 1];
}

// Inverse transpose of the upper 3x3: the matrix of cofactors, up to scale.
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
  constructor(meshes, scene, front, back) {
    const canvas = document.createElement("canvas");
    const gl = canvas.getContext("webgl2", { antialias: false, depth: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("this browser has no WebGL2");
    if (!gl.getExtension("EXT_color_buffer_float")) throw new Error("WebGL2 here cannot draw into float textures");
    this.gl = gl;
    this.scene = scene;
    const info = gl.getExtension("WEBGL_debug_renderer_info");
    this.name = gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
    this.programs = { sample: this.program(VERTEX, SAMPLE(scene.cutouts)), pixel: this.program(WHOLE, PIXEL) };
    this.front = this.light(front);
    this.back = back ? this.light(back) : this.front;
    this.nodes = meshes.flatMap((mesh) => {
      const shared = this.vertices(mesh), box = boxMatrix(mesh.low, mesh.extent);
      return mesh.placements.map((m) => ({ ...shared, placed: product(m, box), normal: normalMatrix(m) }));
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

  light(image) {
    const gl = this.gl, texture = gl.createTexture();
    if (image.width > gl.getParameter(gl.MAX_TEXTURE_SIZE))
      throw new Error(`textures of ${image.width} texels are too large here`);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, image);
    for (const [key, value] of [
      [gl.TEXTURE_MIN_FILTER, gl.LINEAR], [gl.TEXTURE_MAG_FILTER, gl.LINEAR],
      [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE],
    ]) gl.texParameteri(gl.TEXTURE_2D, key, value);
    return texture;
  }

  vertices(mesh) {
    const gl = this.gl, array = gl.createVertexArray();
    gl.bindVertexArray(array);
    [
      [mesh.positions, 3, gl.UNSIGNED_SHORT, true],
      [mesh.normals, 3, gl.SHORT, false],
      [mesh.atlas, 2, gl.UNSIGNED_SHORT, true],
    ].forEach(([values, count, kind, normalised], index) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(index);
      gl.vertexAttribPointer(index, count, kind, normalised, 0, 0);
    });
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, mesh.indices, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    return { array, count: mesh.indices.length };
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
    for (const old of [this.fine, this.pixels].filter(Boolean)) {
      old.textures.forEach((texture) => gl.deleteTexture(texture));
      gl.deleteRenderbuffer(old.depths);
      gl.deleteFramebuffer(old.buffer);
    }
    (this.copies || []).forEach((copy) => gl.deleteBuffer(copy));
    this.fine = this.target(FINER * width, FINER * height, [gl.RG32UI], true);
    this.pixels = this.target(width, height, [gl.RGBA32F, gl.RGBA32F, gl.RGBA32F], false);
    this.copies = this.pixels.textures.map(() => {
      const copy = gl.createBuffer();
      gl.bindBuffer(gl.PIXEL_PACK_BUFFER, copy);
      gl.bufferData(gl.PIXEL_PACK_BUFFER, 16 * width * height, gl.STREAM_READ);
      return copy;
    });
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
    this.size = `${width}x${height}`;
  }

  use(program, target, textures) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.viewport(0, 0, target.width, target.height);
    gl.useProgram(program);
    Object.entries(textures).forEach(([name, texture], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(gl.getUniformLocation(program, name), unit);
    });
    return (name) => gl.getUniformLocation(program, name);
  }

  // Starts to draw a view. The GPU works on while the network computes the frame before; one view at a time.
  begin(view) {
    const gl = this.gl, { width, height } = view, clip = clipMatrix(view, this.scene);
    this.resize(width, height);
    let at = this.use(this.programs.sample, this.fine, { front: this.front });
    const toClip = at("toClip"), placedNormal = at("placedNormal");
    gl.enable(gl.DEPTH_TEST);
    gl.clearBufferuiv(gl.COLOR, 0, [0, 0, 0, 0]);
    gl.clearBufferfv(gl.DEPTH, 0, [1]);
    for (const node of this.nodes) {
      gl.uniformMatrix4fv(toClip, false, product(clip, node.placed));
      gl.uniformMatrix3fv(placedNormal, false, node.normal);
      gl.bindVertexArray(node.array);
      gl.drawElements(gl.TRIANGLES, node.count, gl.UNSIGNED_INT, 0);
    }
    const textures = { samples: this.fine.textures[0], front: this.front, back: this.back };
    at = this.use(this.programs.pixel, this.pixels, textures);
    gl.disable(gl.DEPTH_TEST);
    gl.uniform1f(at("curve"), this.scene.light.curve);
    gl.uniform1f(at("range"), this.scene.light.range);
    gl.bindVertexArray(this.empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindVertexArray(null);
    this.copies.forEach((copy, index) => {
      gl.readBuffer(gl.COLOR_ATTACHMENT0 + index);
      gl.bindBuffer(gl.PIXEL_PACK_BUFFER, copy);
      gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, 0);
    });
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    return { view, fence };
  }

  // What was drawn of a view that was begun: three times Float32Array [H, W, 4], row 0 at the bottom; see PIXEL.
  async drawn({ view, fence }) {
    const gl = this.gl;
    while (gl.clientWaitSync(fence, 0, 0) === gl.TIMEOUT_EXPIRED) await new Promise((done) => setTimeout(done));
    gl.deleteSync(fence);
    const [base, normal, uv] = this.copies.map((copy) => {
      const values = new Float32Array(4 * view.width * view.height);
      gl.bindBuffer(gl.PIXEL_PACK_BUFFER, copy);
      gl.getBufferSubData(gl.PIXEL_PACK_BUFFER, 0, values);
      return values;
    });
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
    return { base, normal, uv };
  }
}

// Numbers of the pixels that surfaces cover, at least in part: row by row from the top.
function coveredPixels({ normal }, { width, height }) {
  const found = new Uint32Array(width * height);
  let count = 0;
  for (let y = 0, pixel = 0; y < height; y++)
    for (let x = 0; x < width; x++, pixel++)
      if (normal[4 * (width * (height - 1 - y) + x) + 3] > 0) found[count++] = pixel;
  return found.subarray(0, count);
}

// The network's inputs for those pixels, Float32Array [C, pixels] by name.
function networkInputs({ base, normal, uv }, view, pixels) {
  const { width, height, fl_x, fl_y, cx, cy, c2w } = view, count = pixels.length, inputs = {};
  for (const [name, channels] of Object.entries(CHANNELS)) inputs[name] = new Float32Array(channels * count);
  for (let i = 0; i < count; i++) {
    const y = Math.floor(pixels[i] / width), x = pixels[i] - width * y, from = 4 * (width * (height - 1 - y) + x);
    // From the surface to the camera: minus the ray through the pixel's centre. Normals look that way, too.
    const a = (x + 0.5 - cx) / fl_x, b = -(y + 0.5 - cy) / fl_y, length = Math.sqrt(a * a + b * b + 1);
    let cosine = 0;
    for (let r = 0; r < 3; r++) {
      const towards = -(c2w[r][0] * a + c2w[r][1] * b - c2w[r][2]) / length;
      inputs.view_dir[r * count + i] = towards;
      cosine += towards * normal[from + r];
    }
    for (let r = 0; r < 3; r++) inputs.normal[r * count + i] = cosine < 0 ? -normal[from + r] : normal[from + r];
    for (let c = 0; c < 4; c++) inputs.base[c * count + i] = base[from + c];
    inputs.uv[i] = uv[from];
    inputs.uv[count + i] = uv[from + 1];
    inputs.mask[i] = base[from + 3];
    inputs.coverage[i] = normal[from + 3];
  }
  return inputs;
}

// World -> clip space; OpenGL's camera axes, pixel (0, 0) at the top left.
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
  const columns = (rows) => [0, 1, 2, 3].flatMap((c) => rows.map((row) => row[c]));
  return product(columns(lens), columns(camera));
}

// ---- network -----------------------------------------------------------------------------------------------------

const CHANNELS = { uv: 2, mask: 1, coverage: 1, view_dir: 3, normal: 3, base: 4 };

class Network {
  static async load() {
    const network = new Network(), bundle = "ort/ort.wasm.bundle.min.mjs";
    const [model, binary] = await Promise.all(["model.onnx", "ort/ort-wasm-simd-threaded.wasm"].map(unpacked));
    let address = new URL(bundle, location.href).href;
    if (offline) address = URL.createObjectURL(new Blob([await file(bundle)], { type: "text/javascript" }));
    network.ort = await import(address);
    const wasm = network.ort.env.wasm;
    wasm.wasmBinary = binary.buffer;
    // Only where the server isolates origins may threads share memory.
    wasm.numThreads = self.crossOriginIsolated ? Math.min(4, navigator.hardwareConcurrency) : 1;
    network.session = await network.ort.InferenceSession.create(model, {
      executionProviders: ["wasm"],
      enableMemPattern: false, // it would keep one for each number of pixels
    });
    network.provider = `WebAssembly, threads: ${wasm.numThreads}`;
    return network;
  }

  // Display RGB over white of any pixels, Float32Array [3, pixels]. The network looks at each by itself, so they need
  // not be a picture.
  async run(inputs) {
    const feeds = {}, count = inputs.mask.length;
    for (const name of this.session.inputNames)
      feeds[name] = new this.ort.Tensor("float32", inputs[name], [1, CHANNELS[name], 1, count]);
    return (await this.session.run(feeds, ["rgb"])).rgb.data;
  }
}

// ---- page --------------------------------------------------------------------------------------------------------

const $ = (id) => document.getElementById(id);

class Page {
  constructor(scene, raster, network) {
    Object.assign(this, { scene, raster, network, times: [], left: 0, round: 0, busy: false, probing: false });
    $("title").textContent = `${scene.name}: neural view`;
    const native = scene.size[0];
    for (const side of [...new Set([native / 2, native, native * 1.5, native * 2].map(Math.round))])
      $("size").add(new Option(this.dimensions(side).join(" × "), side, side === native, side === native));
    this.reset();
    for (const id of ["show", "size", "turn"]) $(id).onchange = () => this.touch(true);
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
    this.loop();
  }

  reset() {
    Object.assign(this, this.scene.start);
    this.touch(true);
  }

  // Draw again. fresh: what a frame costs has changed.
  touch(fresh = false) {
    const limit = Math.PI / 2 - 0.02;
    this.elevation = Math.min(limit, Math.max(-limit, this.elevation));
    this.distance = Math.min(6 * this.scene.start.distance, Math.max(0.1 * this.scene.radius, this.distance));
    if (fresh) {
      this.times = [];
      this.round += 1;
    }
    this.left = MEASURED;
  }

  dimensions(side) {
    const [width, height] = this.scene.size;
    return [side, Math.round((height * side) / width)];
  }

  // The orbiting camera: upright whatever its angles, since `right` is horizontal.
  view(side = Number($("size").value)) {
    const { center, size, lens } = this.scene, scale = side / size[0], [width, height] = this.dimensions(side);
    const [ca, sa, ce, se] = [this.azimuth, this.elevation].flatMap((t) => [Math.cos(t), Math.sin(t)]);
    const back = [ca * ce, sa * ce, se], right = [-sa, ca, 0], up = [-ca * se, -sa * se, ce];
    const c2w = [0, 1, 2].map((r) => [right[r], up[r], back[r], center[r] + this.distance * back[r]]);
    return {
      width, height, fl_x: lens[0] * scale, fl_y: lens[1] * scale, cx: width / 2, cy: height / 2,
      c2w: [...c2w, [0, 0, 0, 1]],
    };
  }

  next() {
    if ($("turn").checked) {
      this.azimuth += 0.02;
      this.left = MEASURED;
    }
    if (this.left === 0 || this.probing) return null;
    this.left -= 1;
    return { ...this.raster.begin(this.view()), round: this.round };
  }

  // Frame after frame while there is something to show. The picture is one frame behind the camera: while the network
  // computes it, the GPU draws the next one.
  async loop() {
    let begun = null, since = null;
    for (;;) {
      begun = begun || this.next();
      this.busy = begun !== null;
      if (begun) {
        try {
          const { round } = begun, started = since || performance.now();
          ({ begun } = await this.frame(begun, $("show").value, () => this.next()));
          since = begun ? performance.now() : null;
          if (round === this.round) this.note([...this.last, performance.now() - started], !begun);
          if ($("message").textContent) $("message").textContent = "";
        } catch (error) {
          fail(error);
          throw error;
        }
      }
      // Also lets the browser show the picture and hear the mouse.
      await (begun ? new Promise((done) => setTimeout(done)) : new Promise(requestAnimationFrame));
    }
  }

  // Shows a view that was begun. next: begins another one, or answers null.
  async frame(begun, show, next) {
    const started = performance.now(), { view } = begun, drawn = await this.raster.drawn(begun);
    const waited = performance.now() - started, pixels = coveredPixels(drawn, view);
    begun = next();
    const inputs = networkInputs(drawn, view, pixels), asked = performance.now();
    const colours = show !== "neural" ? plain(inputs, show) : pixels.length ? await this.network.run(inputs) : [];
    this.last = [waited, performance.now() - asked];
    this.paint(pixels, colours, view);
    return { drawn, pixels, colours, begun };
  }

  paint(pixels, colours, { width, height }) {
    const canvas = $("picture"), count = pixels.length, image = new ImageData(width, height);
    image.data.fill(255);
    for (let i = 0; i < count; i++)
      for (let c = 0; c < 3; c++) image.data[4 * pixels[i] + c] = 255 * colours[c * count + i] + 0.5;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    // Its pixels stay in main memory: they are written there anew each frame.
    canvas.getContext("2d", { willReadFrequently: true }).putImageData(image, 0, 0);
  }

  note(times, last) {
    this.times.push(times);
    if (this.times.length > RECENT) this.times.shift();
    // Laying out text takes time, too.
    if (!last && performance.now() - (this.reported || 0) < 250) return;
    this.reported = performance.now();
    this.report();
  }

  // Means over the last frames. wait_ms: for the GPU; it draws while the network computes, so little of it may be left.
  figures() {
    const mean = (k) => this.times.reduce((sum, time) => sum + time[k], 0) / this.times.length;
    return {
      wait_ms: mean(0), network_ms: mean(1), frame_ms: mean(2), fps: 1000 / mean(2), frames: this.times.length,
      provider: this.network.provider, gl: this.raster.name,
    };
  }

  report() {
    const f = this.figures(), q = this.scene.quality, decibels = (value) => `${value.toFixed(1)} dB`;
    $("fps").textContent = `${f.fps.toFixed(1)} frames a second`;
    const rows = [
      ["this page", `${decibels(q.psnr)} PSNR over ${q.test_views} ray-traced held-out views at ` +
        `${this.scene.size.join(" × ")}; its baked light alone ${decibels(q.psnr_base)}`],
      ["workspace's renderer", q.psnr_workspace === null ? "not measured (dnrpipe evaluate)"
        : `${decibels(q.psnr_workspace)} PSNR over the same views, with ray-traced mirrors and highlights`],
      ["frame", `${f.frame_ms.toFixed(0)} ms: network ${f.network_ms.toFixed(0)}, waiting for WebGL2 ` +
        `${f.wait_ms.toFixed(0)}; mean of ${f.frames}`],
      ["network runs on", f.provider],
      ["WebGL2", f.gl],
    ];
    $("figures").replaceChildren(...rows.map((row) => {
      const line = document.createElement("tr");
      line.append(...row.map((text) => Object.assign(document.createElement("td"), { textContent: text })));
      return line;
    }));
  }

  // Runs something while the loop rests.
  async alone(action) {
    this.probing = true;
    while (this.busy) await new Promise((done) => setTimeout(done, 5));
    try {
      return await action();
    } finally {
      this.probing = false;
    }
  }

  // A frame of a given camera, for checks: inputs and picture of all pixels as base64 of float32 [C, H, W].
  async probe(view) {
    const { drawn, pixels, colours } = await this.alone(() => this.frame(this.raster.begin(view), "neural", () => null));
    const count = view.width * view.height, rgb = new Float32Array(3 * count).fill(1);
    pixels.forEach((pixel, i) => {
      for (let c = 0; c < 3; c++) rgb[c * count + pixel] = colours[c * pixels.length + i];
    });
    const coded = (values) => {
      const bytes = new Uint8Array(values.buffer, values.byteOffset, values.byteLength);
      let text = "";
      for (let i = 0; i < bytes.length; i += 8192) text += String.fromCharCode(...bytes.subarray(i, i + 8192));
      return btoa(text);
    };
    const inputs = networkInputs(drawn, view, Uint32Array.from({ length: count }, (_, i) => i));
    return Object.fromEntries(Object.entries({ ...inputs, rgb }).map(([name, values]) => [name, coded(values)]));
  }

  // Figures of a turntable of that width, for checks.
  async measure(side) {
    $("size").add(new Option(this.dimensions(side).join(" × "), side, false, true));
    $("turn").checked = true;
    for (let run = 0; run < 2; run++) { // the first one warms up
      this.touch(true);
      while (this.times.length < RECENT) await new Promise((done) => setTimeout(done, 50));
    }
    $("turn").checked = false;
    return this.figures();
  }
}

// Baked light (exposed plainly, not by the scene's display transform) or normals over white.
function plain(inputs, show) {
  const count = inputs.mask.length, colours = new Float32Array(3 * count);
  for (let i = 0; i < count; i++)
    for (let c = 0; c < 3; c++) {
      const value = show === "normal" ? 0.5 + 0.5 * inputs.normal[c * count + i]
        : Math.min(1, inputs.base[c * count + i]) ** (1 / 2.2);
      colours[c * count + i] = 1 + inputs.mask[i] * (value - 1);
    }
  return colours;
}

function fail(error) {
  $("message").textContent = `${error.message || error}`;
}

async function start() {
  if (offline) await script("offline.js");
  const scene = offline ? window.DNR_OFFLINE.scene : JSON.parse(new TextDecoder().decode(await file("scene.json")));
  const [mesh, front, back, network] = await Promise.all([
    unpacked("scene.bin"), picture("light-front.webp"), scene.thin ? picture("light-back.webp") : null, Network.load(),
  ]);
  return new Page(scene, new Raster(readMeshes(mesh, scene.meshes), scene, front, back), network);
}

window.dnr = start();
window.dnr.catch(fail);
