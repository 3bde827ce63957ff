// The newest frame, and what was read and expected in it, drawn over.

import { COLOURS, Surface, polyline } from "./charts.js";

export class Picture {
  constructor(canvas, layers) {
    this.layers = layers; this.content = null; this.bitmap = null; this.heat = null;
    this.waiting = null; this.isDecoding = false;
    this.surface = new Surface(canvas, () => this.draw());
  }
  // Takes what a frame shows, and its JPEG; while one is decoded, only the newest waits.
  async show(content, bytes) {
    this.waiting = [content, bytes];
    if (this.isDecoding) return;
    this.isDecoding = true;
    try {
      while (this.waiting) {
        const [next, jpeg] = this.waiting;
        this.waiting = null;
        const bitmap = await createImageBitmap(new Blob([jpeg], { type: "image/jpeg" }));
        if (this.bitmap) this.bitmap.close();
        this.content = next; this.bitmap = bitmap;
        this.draw();
      }
    } finally {
      this.isDecoding = false;
    }
  }
  async showHeat(content, bytes) {
    const bitmap = content.is_lit ? await createImageBitmap(new Blob([bytes], { type: "image/png" })) : null;
    if (this.heat) this.heat.bitmap.close();
    this.heat = bitmap && { bitmap, reach: content.reach };
  }
  draw() {
    const context = this.surface.clear(), { width, height } = this.surface, { content, bitmap } = this;
    if (!bitmap) {
      context.fillStyle = COLOURS.soft; context.font = "15px system-ui, 'DejaVu Sans', sans-serif"; context.textAlign = "center"; context.textBaseline = "middle";
      context.fillText("no frame yet", width / 2, height / 2);
      return;
    }
    const scale = Math.min(width / content.width, height / content.height);
    const left = (width - scale * content.width) / 2, top = (height - scale * content.height) / 2;
    context.drawImage(bitmap, left, top, scale * content.width, scale * content.height);
    if (this.heat && this.layers.heat) {
      context.drawImage(this.heat.bitmap, left, top, scale * content.width * this.heat.reach[0], scale * content.height * this.heat.reach[1]);
    }
    // A pixel's centre has whole numbers.
    const xOf = (x) => left + scale * (x + 0.5), yOf = (y) => top + scale * (y + 0.5);
    context.save();
    context.beginPath(); context.rect(left, top, scale * content.width, scale * content.height); context.clip();
    if (this.layers.expected) polyline(context, content.expected, xOf, yOf, COLOURS.expected, 1.5, [7, 6]);
    if (this.layers.stripe) polyline(context, content.stripe, xOf, yOf, COLOURS.stripe, 2, []);
    if (this.layers.joint) this.joint(context, content, xOf, yOf);
    context.restore();
  }
  joint(context, content, xOf, yOf) {
    context.fillStyle = COLOURS.joint;
    for (let k = 2; k < content.corners.length - 2; k += 2) {
      if (content.corners[k] !== null && content.corners[k + 1] !== null) context.fillRect(xOf(content.corners[k]) - 4, yOf(content.corners[k + 1]) - 4, 8, 8);
    }
    if (!content.seam) return;
    const x = xOf(content.seam[0]), y = yOf(content.seam[1]);
    context.strokeStyle = content.is_valid ? COLOURS.joint : COLOURS.red; context.lineWidth = 2.5;
    context.beginPath(); context.moveTo(x - 16, y); context.lineTo(x + 16, y); context.moveTo(x, y - 16); context.lineTo(x, y + 16); context.stroke();
  }
}
