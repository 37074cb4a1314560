// Small charts: a line per region over the last minute.
import { cssColour, regionColour } from './palette.js';

const span = 60_000;  // ms
const redrawMs = 1000;
const width = 232, height = 44;

export class Chart {
  // `format(value)`: for the largest newest value. `floor` and `ceiling`: what the upper end stands for at least, at most.
  constructor(parent, title, { format, floor, ceiling = Infinity, hint = '' }) {
    this.format = format;
    this.ceiling = ceiling;
    this.floor = floor;
    this.series = new Map();  // region -> [[time, value], ...]
    const figure = document.createElement('figure');
    const caption = document.createElement('figcaption');
    caption.append(title);
    caption.title = hint;
    this.value = document.createElement('b');
    caption.append(this.value);
    this.canvas = document.createElement('canvas');
    this.canvas.width = width;
    this.canvas.height = height;
    figure.append(caption, this.canvas);
    parent.append(figure);
    // Kept in the processor's memory: small pictures are slow to draw where there is no graphics card.
    this.context = this.canvas.getContext('2d', { willReadFrequently: true });
    this.changed = true;
    this.drawn = 0;
  }

  clear() {
    this.series.clear();
    this.changed = true;
  }

  add(region, time, value) {
    if (!Number.isFinite(value)) return;
    let points = this.series.get(region);
    if (points === undefined) this.series.set(region, (points = []));
    if (points.length > 0 && time < points.at(-1)[0]) points.length = 0;
    points.push([time, value]);
    while (points[0][0] < time - span) points.shift();
    this.changed = true;
  }

  // At most once a second.
  draw(time) {
    if (!this.changed || time < this.drawn + redrawMs) return;
    this.drawn = time;
    this.changed = false;
    const c = this.context;
    const { width: w, height: h } = this.canvas;
    c.clearRect(0, 0, w, h);
    let top = this.floor, newest = null;
    for (const points of this.series.values()) {
      for (const [, value] of points) top = Math.max(top, value);
      const last = points.at(-1)[1];
      newest = newest === null ? last : Math.max(newest, last);
    }
    top = Math.min(top, this.ceiling);
    c.strokeStyle = '#2c3138';
    c.lineWidth = 1;
    c.strokeRect(0.5, 0.5, w - 1, h - 1);
    c.lineWidth = 1.3;
    for (const [region, points] of this.series) {
      c.strokeStyle = cssColour(regionColour(region));
      c.beginPath();
      for (const [at, value] of points) c.lineTo(w - ((time - at) / span) * w, h - 3 - Math.min(1, value / top) * (h - 6));
      c.stroke();
    }
    c.fillStyle = '#8b939d';
    c.font = '9px system-ui, sans-serif';
    c.fillText(this.format(top), 4, 11);
    this.value.textContent = newest === null ? 'no data' : this.format(newest);
  }
}
