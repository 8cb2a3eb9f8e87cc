// One map of heights as a surface, a mesh or a flat map. The bytes come over HTTP, are kept as float textures, and
// a frame is drawn only when something changed, so that a panel without a graphics card stays usable.
import { THREE, OrbitControls } from "nicegui-scene";

const MISSING = -1e9;
const STOPS = {
  height: ["#00224e", "#123570", "#3b496c", "#575d6d", "#707173", "#8a8678", "#a59c74", "#c3b369", "#e1cc55", "#fee838"],
  signed: ["#1f5fa8", "#5d9fd0", "#bcd9ec", "#f5f5f2", "#fbd0b5", "#ea8559", "#a9232f"],
  size: ["#dfe3e6", "#f7d9a4", "#f3a45e", "#dc5a36", "#8c1420"],
};

const VERTEX = `
uniform highp sampler2D heights; uniform highp sampler2D colours;
uniform ivec2 size; uniform float gap; uniform float middle; uniform float relief;
out float isThere; out float value; out vec3 normalWorld;
float at(ivec2 p) { return texelFetch(heights, clamp(p, ivec2(0), size - 1), 0).r; }
float slope(float before, float here, float after) {
  bool b = before > -1e8, a = after > -1e8;
  return a && b ? 0.5 * (after - before) : a ? after - here : b ? here - before : 0.0;
}
void main() {
  ivec2 p = ivec2(position.xy);
  float z = at(p);
  value = texelFetch(colours, p, 0).r;
  isThere = z > -1e8 && value > -1e8 ? 1.0 : 0.0;
  // At the rim of a hole the huge sentinel would leave hairlines of any colour.
  if (isThere < 0.5) value = 0.0;
  float shown = isThere > 0.5 ? (z - middle) * relief : 0.0;
  float dx = slope(at(p - ivec2(1, 0)), z, at(p + ivec2(1, 0))) * relief / gap;
  float dy = -slope(at(p - ivec2(0, 1)), z, at(p + ivec2(0, 1))) * relief / gap;
  normalWorld = normalize(vec3(-dx, -dy, 1.0));
  vec2 xy = vec2(position.x - 0.5 * float(size.x - 1), 0.5 * float(size.y - 1) - position.y) * gap;
  gl_Position = projectionMatrix * modelViewMatrix * vec4(xy, shown, 1.0);
}`;

const FRAGMENT = `
precision highp float;
uniform sampler2D ramp; uniform float low; uniform float high; uniform float shade;
in float isThere; in float value; in vec3 normalWorld;
out vec4 colour;
void main() {
  if (isThere < 0.999) discard;
  float t = clamp((value - low) / max(high - low, 1e-9), 0.0, 1.0);
  vec3 own = texture(ramp, vec2((t * 255.0 + 0.5) / 256.0, 0.5)).rgb;
  float light = max(dot(normalize(normalWorld), normalize(vec3(-0.45, 0.55, 0.75))), 0.0);
  colour = vec4(own * mix(1.0, 0.35 + 0.85 * light, shade), 1.0);
}`;

function ramp(kind) {
  const stops = STOPS[kind].map((hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16)));
  const bytes = new Uint8Array(256 * 4);
  for (let i = 0; i < 256; i++) {
    const at = (i / 255) * (stops.length - 1);
    const k = Math.min(Math.floor(at), stops.length - 2);
    for (let c = 0; c < 3; c++) bytes[4 * i + c] = stops[k][c] + (stops[k + 1][c] - stops[k][c]) * (at - k);
    bytes[4 * i + 3] = 255;
  }
  const texture = new THREE.DataTexture(bytes, 256, 1, THREE.RGBAFormat);
  texture.magFilter = THREE.LinearFilter;
  texture.needsUpdate = true;
  return texture;
}

export default {
  template: `
    <div class="surface" :data-painted="painted" :data-count="count">
      <canvas ref="canvas" tabindex="0" role="img" :aria-label="label" @keydown="onKey"
        @pointermove="onMove" @pointerleave="tip = null" @pointerdown="onDown" @pointerup="onUp"></canvas>
      <svg class="surface-ruler" aria-hidden="true" v-if="line">
        <line :x1="line.x1" :y1="line.y1" :x2="line.x2" :y2="line.y2" /><circle :cx="line.x1" :cy="line.y1" r="5" />
        <circle :cx="line.x2" :cy="line.y2" r="5" />
      </svg>
      <div class="surface-note" v-if="note">{{ note }}</div>
      <div class="surface-tip" v-if="tip" :style="{left: tip.x + 'px', top: tip.y + 'px'}">{{ tip.text }}</div>
      <div class="surface-legend" v-if="scale" aria-hidden="true">
        <span>{{ number(scale.high_mm) }}</span><div :style="{background: gradient}"></div>
        <span>{{ number(scale.low_mm) }} {{ scale.unit }}</span>
      </div>
      <div class="surface-foot" v-if="scale">{{ foot }}</div>
      <div class="surface-length" v-if="length" role="status">{{ length }}</div>
    </div>`,
  props: { words: Object, header: Object, map: String, painting: String, ruler: Boolean },
  data: () => ({ painted: "", count: 0, note: "", tip: null, scale: null, line: null, length: "", gradient: "" }),
  computed: {
    label() {
      if (!this.header) return this.words.waiting;
      return `${this.words[this.map] || this.map}, ${this.words.stroke} ${this.header.stroke}. ${this.words.keys}`;
    },
    foot() {
      const h = this.header;
      const side = (n) => this.plain((n - 1) * h.step, 0);
      const relief = this.painting === "flat" || this.scale.relief === 1 ? "" : ` · ${this.words.relief} ×${this.scale.relief}`;
      return `${this.words.stroke} ${h.stroke} · ${side(h.cols)} × ${side(h.rows)} ${h.unit}${relief}`;
    },
  },
  watch: {
    header() { this.load(); },
    map() { this.dress(); },
    painting() { this.dress(true); },
    ruler() { this.ends = []; this.line = null; this.length = ""; },
  },
  mounted() {
    this.note = this.words.waiting;
    this.ends = [];
    try {
      this.renderer = new THREE.WebGLRenderer({ canvas: this.$refs.canvas, antialias: true, alpha: true, preserveDrawingBuffer: true });
    } catch (error) {
      this.note = this.words.no_webgl;
      return;
    }
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(32, 1, 0.1, 1e6);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, this.$refs.canvas);
    this.controls.enableDamping = false;
    this.controls.addEventListener("change", () => this.invalidate());
    this.uniforms = {
      heights: { value: null }, colours: { value: null }, size: { value: [1, 1] }, gap: { value: 1 }, middle: { value: 0 },
      relief: { value: 1 }, ramp: { value: null }, low: { value: 0 }, high: { value: 1 }, shade: { value: 1 },
    };
    this.material = new THREE.ShaderMaterial({
      glslVersion: THREE.GLSL3, vertexShader: VERTEX, fragmentShader: FRAGMENT, uniforms: this.uniforms, side: THREE.DoubleSide,
    });
    this.ramps = {};
    this.resizer = new ResizeObserver(() => this.resize());
    this.resizer.observe(this.$el);
    this.load();
  },
  beforeUnmount() {
    this.resizer?.disconnect();
    this.controls?.dispose();
    this.forget();
    this.renderer?.dispose();
  },
  methods: {
    plain(value, digits) { return value.toFixed(digits).replace("-", "−").replace(".", this.words.point); },
    number(value) { return this.plain(value, Math.abs(value) >= 10 ? 1 : 2); },
    async load() {
      if (!this.header || !this.renderer) return;
      const wanted = this.header;
      let bytes;
      try {
        const answer = await fetch(wanted.url);
        // A newer stroke has replaced these maps; its header is on its way.
        if (answer.status === 404) return;
        if (!answer.ok) throw new Error(answer.statusText);
        bytes = await answer.arrayBuffer();
      } catch (error) {
        this.note = this.words.not_loaded;
        return;
      }
      if (wanted !== this.header) return;
      const size = wanted.rows * wanted.cols;
      if (bytes.byteLength !== 4 * size * wanted.names.length) { this.note = this.words.not_loaded; return; }
      this.maps = wanted.names.map((name, i) => {
        const values = new Float32Array(bytes, 4 * size * i, size);
        for (let k = 0; k < size; k++) if (!Number.isFinite(values[k])) values[k] = MISSING;
        return values;
      });
      this.textures?.forEach((t) => t.dispose());
      this.textures = this.maps.map((values) => {
        const texture = new THREE.DataTexture(values, wanted.cols, wanted.rows, THREE.RedFormat, THREE.FloatType);
        texture.needsUpdate = true;
        return texture;
      });
      this.ends = []; this.line = null; this.length = "";
      const isNewSize = this.rows !== wanted.rows || this.cols !== wanted.cols || this.gap !== wanted.step;
      if (isNewSize) this.build(wanted);
      this.note = "";
      this.dress(isNewSize);
    },
    build(h) {
      this.forget();
      [this.rows, this.cols, this.gap] = [h.rows, h.cols, h.step];
      const corners = new Float32Array(3 * h.rows * h.cols);
      for (let r = 0, k = 0; r < h.rows; r++) for (let c = 0; c < h.cols; c++, k += 3) { corners[k] = c; corners[k + 1] = r; }
      const position = new THREE.BufferAttribute(corners, 3);
      const faces = [], edges = [];
      for (let r = 0; r < h.rows; r++) for (let c = 0; c < h.cols; c++) {
        const k = r * h.cols + c;
        if (c + 1 < h.cols) edges.push(k, k + 1);
        if (r + 1 < h.rows) edges.push(k, k + h.cols);
        if (c + 1 < h.cols && r + 1 < h.rows) faces.push(k, k + h.cols, k + 1, k + 1, k + h.cols, k + h.cols + 1);
      }
      const shape = (index, Kind) => {
        const geometry = new THREE.BufferGeometry();
        geometry.setAttribute("position", position);
        geometry.setIndex(index);
        const object = new Kind(geometry, this.material);
        object.frustumCulled = false;
        this.scene.add(object);
        return object;
      };
      this.solid = shape(faces, THREE.Mesh);
      this.mesh = shape(edges, THREE.LineSegments);
    },
    forget() {
      for (const object of [this.solid, this.mesh]) {
        if (object) { this.scene.remove(object); object.geometry.dispose(); }
      }
    },
    dress(looksAnew = false) {
      if (!this.textures) return;
      const h = this.header;
      const i = Math.max(h.names.indexOf(this.map), 0);
      // Errors are shown where they are on the part; a difference has a relief of its own.
      const k = h.names[i] === "error" && h.names.includes("measured") ? h.names.indexOf("measured") : i;
      const scale = h.scales[i];
      const shape = h.scales[k];
      this.scale = { ...scale, relief: shape.relief };
      this.values = this.maps[i];
      this.heights = this.maps[k];
      const isFlat = this.painting === "flat";
      const u = this.uniforms;
      u.heights.value = this.textures[k];
      u.colours.value = this.textures[i];
      u.size.value = [h.cols, h.rows];
      u.gap.value = h.step;
      u.middle.value = 0.5 * (shape.low_mm + shape.high_mm);
      u.relief.value = isFlat ? 0 : shape.relief;
      u.low.value = scale.low_mm;
      u.high.value = scale.high_mm;
      u.shade.value = isFlat ? 0 : scale.kind === "height" ? 1 : 0.55;
      u.ramp.value = this.ramps[scale.kind] ||= ramp(scale.kind);
      this.gradient = `linear-gradient(to top, ${STOPS[scale.kind].join(",")})`;
      this.solid.visible = this.painting !== "mesh";
      this.mesh.visible = this.painting === "mesh";
      if (looksAnew) this.lookAnew();
      this.dressed = `${h.cycle_id}:${h.names[i]}`;
      this.resize();
    },
    lookAnew() {
      const width = this.cols * this.gap, depth = this.rows * this.gap;
      const aspect = this.camera.aspect || 1.5;
      const isFlat = this.painting === "flat";
      const half = Math.tan((this.camera.fov * Math.PI) / 360);
      const away = (isFlat ? 1.12 : 1.16) * Math.max(width / (2 * half * aspect), (isFlat ? depth : 0.85 * depth) / (2 * half));
      this.controls.target.set(0, 0, 0);
      this.camera.position.set(0, isFlat ? -1e-3 * away : -0.82 * away, isFlat ? away : 0.78 * away);
      this.camera.near = away / 100;
      this.camera.far = away * 20;
      this.camera.updateProjectionMatrix();
      this.controls.enableRotate = !isFlat;
      this.controls.update();
    },
    resize() {
      const width = this.$el.clientWidth, height = this.$el.clientHeight;
      if (!width || !height || !this.renderer) return;
      const aspect = width / height;
      if (this.width !== width || this.height !== height) {
        [this.width, this.height] = [width, height];
        this.renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 1.5));
        this.renderer.setSize(width, height, false);
        this.camera.aspect = aspect;
        this.camera.updateProjectionMatrix();
        if (this.textures && !this.wasTurned) this.lookAnew();
      }
      this.invalidate();
    },
    invalidate() {
      if (this.isAsked || !this.textures) return;
      this.isAsked = true;
      requestAnimationFrame(() => {
        this.isAsked = false;
        if (!this.renderer || !this.textures) return;
        this.renderer.render(this.scene, this.camera);
        this.placeRuler();
        this.painted = this.dressed;
        this.count += 1;
      });
    },
    // The place of the map under a point of the screen: along the ray until it dips below the surface.
    pick(event) {
      if (!this.textures) return null;
      const box = this.$refs.canvas.getBoundingClientRect();
      const x = ((event.clientX - box.left) / box.width) * 2 - 1, y = 1 - ((event.clientY - box.top) / box.height) * 2;
      const from = new THREE.Vector3(x, y, -1).unproject(this.camera);
      const way = new THREE.Vector3(x, y, 1).unproject(this.camera).sub(from).normalize();
      if (way.z > -1e-6) return null;
      const u = this.uniforms;
      const reach = Math.max((0.5 * (this.header.scales[0].high_mm - this.header.scales[0].low_mm) + 1) * u.relief.value, 1e-3) * 3;
      const start = (reach - from.z) / way.z, end = (-reach - from.z) / way.z;
      const point = new THREE.Vector3();
      let last = null;
      for (let n = 0; n <= 600; n++) {
        point.copy(way).multiplyScalar(start + ((end - start) * n) / 600).add(from);
        const col = Math.round(point.x / this.gap + 0.5 * (this.cols - 1));
        const row = Math.round(0.5 * (this.rows - 1) - point.y / this.gap);
        if (col < 0 || row < 0 || col >= this.cols || row >= this.rows) continue;
        const k = row * this.cols + col;
        if (this.heights[k] <= MISSING || this.values[k] <= MISSING) continue;
        const top = (this.heights[k] - u.middle.value) * u.relief.value;
        if (point.z <= top) {
          last = { row, col, value: this.values[k], height: this.heights[k], z: top };
          break;
        }
      }
      return last;
    },
    world(p) {
      return new THREE.Vector3((p.col - 0.5 * (this.cols - 1)) * this.gap, (0.5 * (this.rows - 1) - p.row) * this.gap, p.z);
    },
    onMove(event) {
      if (event.buttons) { this.tip = null; return; }
      const p = this.pick(event);
      const box = this.$el.getBoundingClientRect();
      const unit = this.header?.unit, unit2 = this.scale?.unit;
      this.tip = p && {
        x: Math.min(event.clientX - box.left + 14, box.width - 190), y: Math.max(event.clientY - box.top - 34, 2),
        text: `x ${this.plain(p.col * this.gap, 1)}  y ${this.plain(p.row * this.gap, 1)} ${unit}   ${this.plain(p.value, unit2 === "%" ? 0 : 3)} ${unit2}`,
      };
    },
    onDown(event) { this.downAt = [event.clientX, event.clientY]; },
    onUp(event) {
      const moved = Math.hypot(event.clientX - this.downAt?.[0], event.clientY - this.downAt?.[1]);
      if (moved > 4) { this.wasTurned = true; return; }
      if (!this.ruler) return;
      const p = this.pick(event);
      if (!p) return;
      this.ends = this.ends.length === 1 ? [this.ends[0], p] : [p];
      this.length = "";
      if (this.ends.length === 2) {
        const [a, b] = this.ends;
        const across = this.gap * Math.hypot(a.col - b.col, a.row - b.row);
        this.length = `${this.words.length} ${this.plain(across, 2)} ${this.header.unit} · ${this.words.rise} ${this.plain(b.height - a.height, 3)} mm`;
      }
      this.placeRuler();
    },
    placeRuler() {
      if (!this.ends.length) { this.line = null; return; }
      const [a, b] = [this.ends[0], this.ends[this.ends.length - 1]].map((p) => this.world(p).project(this.camera));
      const on = (v) => [((v.x + 1) / 2) * this.width, ((1 - v.y) / 2) * this.height];
      const [[x1, y1], [x2, y2]] = [on(a), on(b)];
      this.line = { x1, y1, x2, y2 };
    },
    onKey(event) {
      if (!this.textures) return;
      const turn = { ArrowLeft: [-0.12, 0], ArrowRight: [0.12, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[event.key];
      const zoom = { "+": 0.87, "-": 1.15 }[event.key];
      if (!turn && !zoom && event.key !== "Home") return;
      event.preventDefault();
      this.wasTurned = event.key !== "Home";
      if (event.key === "Home") { this.lookAnew(); this.invalidate(); return; }
      const away = this.camera.position.clone().sub(this.controls.target);
      if (zoom) away.multiplyScalar(zoom);
      else if (this.painting !== "flat") {
        const radius = away.length();
        const around = Math.atan2(away.y, away.x) + turn[0];
        const up = Math.min(Math.max(Math.asin(away.z / radius) - turn[1], 0.1), 1.55);
        away.set(Math.cos(around) * Math.cos(up), Math.sin(around) * Math.cos(up), Math.sin(up)).multiplyScalar(radius);
      }
      this.camera.position.copy(this.controls.target).add(away);
      this.controls.update();
      this.invalidate();
    },
  },
};
