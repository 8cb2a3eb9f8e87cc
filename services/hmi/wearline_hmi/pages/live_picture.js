// The camera picture, polled with one request in flight: the newest frame wins, and its age stands on it.
const PAUSE_MS = 150;

export default {
  template: `
    <div class="live" :data-serial="serial" :class="{old: isOld}">
      <canvas ref="canvas" role="img" :aria-label="label" v-show="serial >= 0"></canvas>
      <div class="live-over" v-if="serial >= 0 && (roi || lines)" :style="over">
        <div class="live-roi" v-if="roi" :style="roiStyle"></div>
        <div v-for="(at, i) in places" :key="i" class="live-line" :class="['line-' + i, across]" :style="lineStyle(at)" tabindex="0"
          role="slider" :aria-label="words.line + ' ' + (i + 1)" :aria-valuemin="0" :aria-valuemax="extent - 1" :aria-valuenow="Math.round(at)"
          @keydown="onKey($event, i)" @pointerdown="onDown($event, i)" @pointermove="onDrag($event, i)" @pointerup="onUp"></div>
      </div>
      <div class="live-note" v-if="serial < 0">{{ words.waiting }}</div>
      <div class="live-age" v-else :class="{old: isOld}"><span class="shape" :class="isOld ? 'clock' : 'check'"></span>{{ age }}</div>
    </div>`,
  // roi: x, y, width, height on the sensor; across: where the movable lines run (column or row), none without it.
  props: { words: Object, staleS: Number, roi: Array, across: String },
  data: () => ({
    serial: -1, takenAt: 0, heardAt: 0, now: 0, isLost: false, step: 1, width: 1, height: 1, over: {}, places: [], dragged: -1,
  }),
  computed: {
    seconds() { return Math.max(0, (this.now - this.takenAt) / 1000); },
    isOld() { return this.isLost || this.now - this.heardAt > 3000 || this.seconds > this.staleS; },
    age() {
      if (this.isLost) return this.words.lost;
      const s = Math.floor(this.seconds);
      const text = s < 1 ? this.words.now : s < 120 ? this.words.seconds.replace("{n}", s) : this.words.minutes.replace("{n}", Math.floor(s / 60));
      return this.now - this.heardAt > 3000 ? `${this.words.silent} · ${text}` : text;
    },
    lines() { return this.across ? 2 : 0; },
    extent() { return this.across === "row" ? this.height : this.width; },
    roiStyle() {
      const part = (n, all) => `${(100 * n) / this.step / all}%`;
      const [x, y, w, h] = this.roi;
      return { left: part(x, this.width), top: part(y, this.height), width: part(w, this.width), height: part(h, this.height) };
    },
    label() { return `${this.words.picture}, ${this.age}`; },
  },
  mounted() {
    this.isOpen = true;
    this.resizer = new ResizeObserver(() => this.place());
    this.resizer.observe(this.$el);
    this.clock = setInterval(() => { this.now = performance.now(); }, 250);
    this.poll();
  },
  beforeUnmount() { this.isOpen = false; clearInterval(this.clock); this.resizer.disconnect(); },
  methods: {
    async poll() {
      while (this.isOpen) {
        if (!document.hidden) await this.take();
        await new Promise((done) => setTimeout(done, PAUSE_MS));
      }
    },
    async take() {
      try {
        const answer = await fetch(`/live/preview.jpg?have=${this.serial}`, { signal: AbortSignal.timeout(5000) });
        if (!answer.ok) { this.isLost = true; return; }
        this.isLost = false;
        const got = performance.now();
        if (!answer.headers.has("X-Serial")) return;
        this.takenAt = got - Number(answer.headers.get("X-Age-Ms"));
        this.heardAt = got - Number(answer.headers.get("X-Heard-Ms"));
        this.now = got;
        if (answer.status !== 200) return;
        const picture = await createImageBitmap(await answer.blob());
        const canvas = this.$refs.canvas;
        if (!canvas) return;
        if (canvas.width !== picture.width || canvas.height !== picture.height) [canvas.width, canvas.height] = [picture.width, picture.height];
        canvas.getContext("2d", { willReadFrequently: true }).drawImage(picture, 0, 0);
        [this.width, this.height, this.step] = [picture.width, picture.height, Number(answer.headers.get("X-Step")) || 1];
        picture.close();
        if (this.lines && !this.places.length) this.places = [0.35, 0.65].map((share) => Math.round(share * this.extent));
        this.place();
        this.tell();
        this.serial = Number(answer.headers.get("X-Serial"));
      } catch (error) {
        this.isLost = true;
      }
    },
    // The canvas is fitted into its box; what lies over it must lie on the picture.
    place() {
      const scale = Math.min(this.$el.clientWidth / this.width, this.$el.clientHeight / this.height, 1e3);
      const [w, h] = [this.width * scale, this.height * scale];
      this.over = {
        width: `${w}px`, height: `${h}px`, left: `${(this.$el.clientWidth - w) / 2}px`, top: `${(this.$el.clientHeight - h) / 2}px`,
      };
      Object.assign(this.$refs.canvas.style, { width: `${w}px`, height: `${h}px` });
    },
    lineStyle(at) { return { [this.across === "row" ? "top" : "left"]: `${(100 * (at + 0.5)) / this.extent}%` }; },
    move(i, at) {
      this.places[i] = Math.min(Math.max(Math.round(at), 0), this.extent - 1);
      this.tell();
    },
    tell() {
      if (!this.lines) return;
      const detail = { canvas: this.$refs.canvas, places: [...this.places], across: this.across, step: this.step };
      window.dispatchEvent(new CustomEvent("wearline-picture", { detail }));
    },
    onKey(event, i) {
      const way = { ArrowLeft: -1, ArrowUp: -1, ArrowRight: 1, ArrowDown: 1, PageUp: -20, PageDown: 20 }[event.key];
      if (!way) return;
      event.preventDefault();
      this.move(i, this.places[i] + way);
    },
    onDown(event, i) { this.dragged = i; event.target.setPointerCapture(event.pointerId); },
    onUp() { this.dragged = -1; },
    onDrag(event, i) {
      if (this.dragged !== i) return;
      const box = event.target.parentElement.getBoundingClientRect();
      const share = this.across === "row" ? (event.clientY - box.top) / box.height : (event.clientX - box.left) / box.width;
      this.move(i, share * this.extent - 0.5);
    },
  },
};
