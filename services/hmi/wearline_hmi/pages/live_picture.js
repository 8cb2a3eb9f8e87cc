// The camera picture, polled with one request in flight: the newest frame wins, and its age stands on it.
const PAUSE_MS = 150;

export default {
  template: `
    <div class="live" :data-serial="serial" :class="{old: isOld}">
      <canvas ref="canvas" role="img" :aria-label="label" v-show="serial >= 0"></canvas>
      <div class="live-note" v-if="serial < 0">{{ words.waiting }}</div>
      <div class="live-age" v-else :class="{old: isOld}"><span class="shape" :class="isOld ? 'clock' : 'check'"></span>{{ age }}</div>
    </div>`,
  props: { words: Object, staleS: Number },
  data: () => ({ serial: -1, takenAt: 0, heardAt: 0, now: 0, isLost: false }),
  computed: {
    seconds() { return Math.max(0, (this.now - this.takenAt) / 1000); },
    isOld() { return this.isLost || this.now - this.heardAt > 3000 || this.seconds > this.staleS; },
    age() {
      if (this.isLost) return this.words.lost;
      const s = Math.floor(this.seconds);
      const text = s < 1 ? this.words.now : s < 120 ? this.words.seconds.replace("{n}", s) : this.words.minutes.replace("{n}", Math.floor(s / 60));
      return this.now - this.heardAt > 3000 ? `${this.words.silent} · ${text}` : text;
    },
    label() { return `${this.words.picture}, ${this.age}`; },
  },
  mounted() {
    this.isOpen = true;
    this.clock = setInterval(() => { this.now = performance.now(); }, 250);
    this.poll();
  },
  beforeUnmount() { this.isOpen = false; clearInterval(this.clock); },
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
        canvas.getContext("2d").drawImage(picture, 0, 0);
        picture.close();
        this.serial = Number(answer.headers.get("X-Serial"));
      } catch (error) {
        this.isLost = true;
      }
    },
  },
};
