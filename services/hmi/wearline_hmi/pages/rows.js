// A plain table of texts and signs (colour, shape and word); rows can be chosen by pointer or keyboard.
export default {
  template: `
    <div class="rows" tabindex="0" role="group" :aria-label="caption">
      <table>
        <caption class="hidden-text">{{ caption }}</caption>
        <thead><tr><th v-for="c in columns" :key="c.key" scope="col" :class="{number: c.number}">{{ c.label }}</th></tr></thead>
        <tbody>
          <tr v-for="row in rows" :key="row.id" :data-id="row.id" :class="{chosen: row.id === chosen, choosable: canChoose, dim: row.dim}"
              @click="choose(row)">
            <template v-for="(c, i) in columns" :key="c.key">
              <td :class="{number: c.number}">
                <span v-if="isSign(row[c.key])" class="sign" :class="row[c.key].colour" :title="row[c.key].title">
                  <span class="shape" :class="row[c.key].icon" aria-hidden="true"></span><span class="word">{{ row[c.key].word }}</span>
                </span>
                <button v-else-if="canChoose && i === 0" type="button" class="row-button" @click.stop="choose(row)">{{ row[c.key] }}</button>
                <template v-else>{{ row[c.key] }}</template>
              </td>
            </template>
          </tr>
          <tr v-if="!rows.length"><td :colspan="columns.length" class="rows-empty">{{ empty }}</td></tr>
        </tbody>
      </table>
    </div>`,
  props: { columns: Array, rows: Array, caption: String, empty: String, chosen: String, canChoose: Boolean },
  emits: ["choose"],
  methods: {
    isSign(cell) { return cell !== null && typeof cell === "object"; },
    choose(row) { if (this.canChoose) this.$emit("choose", row.id); },
  },
};
