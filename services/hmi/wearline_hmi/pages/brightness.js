// What a setter needs to see of the camera picture: brightness along two lines, histogram, saturation, focus.
// Everything is made in the browser from the picture that is shown anyway; the server has no work with it.
const FULL = 250;

export default {
  template: `
    <div class="brightness" :data-serial="count">
      <div class="brightness-profiles"><h3>{{ words.profiles }}</h3><canvas ref="profiles" role="img" :aria-label="profileLabel"></canvas></div>
      <div class="brightness-histogram"><h3>{{ words.histogram }}</h3><canvas ref="histogram" role="img" :aria-label="histogramLabel"></canvas></div>
      <dl class="figures">
        <dt>{{ words.mean }}</dt><dd>{{ mean.toFixed(1) }}</dd>
        <dt>{{ words.saturated }}</dt><dd :class="{bad: saturated > 0.01}">{{ percent(saturated) }}</dd>
        <dt>{{ words.focus }}</dt><dd>{{ focus.toFixed(1) }}</dd>
        <dt>{{ words.best }}</dt><dd>{{ best.toFixed(1) }}</dd>
      </dl>
    </div>`,
  props: { words: Object, ink: Object },
  data: () => ({ count: 0, mean: 0, saturated: 0, focus: 0, best: 0, peaks: [0, 0] }),
  computed: {
    profileLabel() { return `${this.words.profiles}: ${this.words.highest} ${this.peaks.join(", ")}`; },
    histogramLabel() { return `${this.words.histogram}: ${this.words.mean} ${this.mean.toFixed(0)}, ${this.words.saturated} ${this.percent(this.saturated)}`; },
  },
  mounted() {
    this.listen = (event) => { this.shown = event.detail; this.draw(); };
    window.addEventListener("wearline-picture", this.listen);
    this.resizer = new ResizeObserver(() => { if (this.shown) this.draw(); });
    this.resizer.observe(this.$el);
  },
  beforeUnmount() {
    window.removeEventListener("wearline-picture", this.listen);
    this.resizer.disconnect();
  },
  methods: {
    percent(share) { return `${(100 * share).toFixed(2).replace(".", this.words.point)} %`; },
    draw() {
      const { canvas, places, across } = this.shown;
      const { width, height } = canvas;
      const grey = this.grey(canvas, width, height);
      const counts = new Uint32Array(256);
      let sum = 0, full = 0, edge = 0;
      for (let i = 0; i < grey.length; i++) { counts[grey[i]]++; sum += grey[i]; if (grey[i] >= FULL) full++; }
      // Sharp stripes differ much from their neighbours across: the mean square of the step is largest in focus.
      const next = across === "row" ? 1 : width;
      for (let i = 0; i + next < grey.length; i++) { const d = grey[i + next] - grey[i]; edge += d * d; }
      this.mean = sum / grey.length;
      this.saturated = full / grey.length;
      this.focus = Math.sqrt(edge / grey.length);
      this.best = Math.max(this.best, this.focus);
      const profiles = places.map((at) => {
        const line = [];
        if (across === "row") for (let x = 0; x < width; x++) line.push(grey[at * width + x]);
        else for (let y = 0; y < height; y++) line.push(grey[y * width + at]);
        return line;
      });
      this.peaks = profiles.map((line) => Math.max(...line));
      this.drawProfiles(profiles);
      this.drawHistogram(counts);
      this.count += 1;
    },
    grey(canvas, width, height) {
      const rgba = canvas.getContext("2d", { willReadFrequently: true }).getImageData(0, 0, width, height).data;
      const grey = new Uint8Array(width * height);
      for (let i = 0; i < grey.length; i++) grey[i] = rgba[4 * i];
      return grey;
    },
    paper(canvas) {
      const ratio = window.devicePixelRatio || 1;
      const [w, h] = [canvas.clientWidth, canvas.clientHeight];
      [canvas.width, canvas.height] = [w * ratio, h * ratio];
      const pen = canvas.getContext("2d");
      pen.scale(ratio, ratio);
      pen.font = "11px sans-serif";
      pen.fillStyle = this.ink.text;
      pen.strokeStyle = this.ink.grid;
      pen.textAlign = "right";
      for (const level of [0, 64, 128, 192, 255]) {
        const y = h - 14 - ((h - 20) * level) / 255;
        pen.beginPath(); pen.moveTo(30, y); pen.lineTo(w, y); pen.stroke();
        if (canvas === this.$refs.profiles) pen.fillText(level, 26, y + 4);
      }
      return [pen, w, h];
    },
    drawProfiles(profiles) {
      const [pen, w, h] = this.paper(this.$refs.profiles);
      profiles.forEach((line, i) => {
        pen.beginPath();
        line.forEach((v, k) => pen.lineTo(30 + ((w - 30) * k) / (line.length - 1), h - 14 - ((h - 20) * v) / 255));
        pen.strokeStyle = i ? this.ink.event : this.ink.line;
        pen.setLineDash(i ? [4, 2] : []);
        pen.stroke();
      });
      pen.setLineDash([]);
    },
    drawHistogram(counts) {
      const [pen, w, h] = this.paper(this.$refs.histogram);
      const top = Math.log1p(Math.max(...counts));
      counts.forEach((n, k) => {
        const size = ((h - 20) * Math.log1p(n)) / top;
        pen.fillStyle = k >= FULL ? this.ink.limit : this.ink.line;
        pen.fillRect(30 + ((w - 30) * k) / 256, h - 14 - size, (w - 30) / 256 + 0.5, size);
      });
      pen.fillStyle = this.ink.text;
      pen.textAlign = "left"; pen.fillText("0", 30, h - 2);
      pen.textAlign = "right"; pen.fillText("255", w, h - 2);
    },
  },
};
