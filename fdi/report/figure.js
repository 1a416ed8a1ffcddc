// Zoom and cursor for the SVG figures of a page. Each has an attribute data-axes, which fdi/report/drawing.py writes:
// a list with the box of each axes in the figure (points), its limits, and the ids of its lines. On a logarithmic axis
// the limits are decimal logarithms; on a date axis they are days since 1970.
"use strict";
(() => {
  const SVG = "http://www.w3.org/2000/svg";
  const make = (name, attributes, parent) => {
    const e = document.createElementNS(SVG, name);
    for (const key in attributes) e.setAttribute(key, attributes[key]);
    if (parent) parent.append(e);
    return e;
  };
  const box = document.createElement("div");
  box.className = "readout";
  document.body.append(box);

  // an axis: full limits, limits shown, and where the box begins and ends in the figure (y: bottom, top)
  class Axis {
    constructor(limits, kind, start, end) {
      Object.assign(this, {full: limits, low: limits[0], high: limits[1], kind, start, end});
    }
    get zoomed() { return this.low !== this.full[0] || this.high !== this.full[1]; }
    place(u) { return this.start + (u - this.low) / (this.high - this.low) * (this.end - this.start); }
    read(at) { return this.low + (at - this.start) / (this.end - this.start) * (this.high - this.low); }
    readFull(at) { return this.full[0] + (at - this.start) / (this.end - this.start) * (this.full[1] - this.full[0]); }
    // scale and offset that move what was drawn with the full limits
    get move() {
      const a = (this.full[1] - this.full[0]) / (this.high - this.low);
      return [a, this.place(this.full[0]) - a * this.start];
    }
    set(low, high) {
      const [least, most] = this.full, down = least > most, size = Math.abs(most - least);
      if (down) [low, high] = [Math.min(low, least), Math.max(high, most)];
      else [low, high] = [Math.max(low, least), Math.min(high, most)];
      if (Math.abs(high - low) < 1e-6 * size) return;
      this.low = low; this.high = high;
    }
    reset() { [this.low, this.high] = this.full; }
    value(u) { return this.kind === "log" ? 10 ** u : u; }
    // round values within the limits, as [position, text]
    ticks(most) {
      const low = Math.min(this.low, this.high), high = Math.max(this.low, this.high);
      if (this.kind === "log" && high - low > 1) {
        const out = [];
        for (let e = Math.floor(low); e <= high; e++)
          for (const m of high - low > 2 ? [1] : [1, 2, 5]) {
            const u = e + Math.log10(m);
            if (u >= low && u <= high) out.push([u, String(+(m * 10 ** e).toPrecision(2))]);
          }
        return out;
      }
      const a = this.value(low), b = this.value(high);
      let step = 10 ** Math.floor(Math.log10((b - a) / most));
      step *= [1, 2, 5, 10].find(m => (b - a) / (m * step) <= most) || 10;
      if (this.kind === "date" && step > 0.2) step = Math.max(1, Math.round(step));
      const out = [];
      for (let k = Math.ceil(a / step - 1e-9); k * step <= b + 1e-9 * step; k++) {
        const v = k * step;
        out.push([this.kind === "log" ? Math.log10(v) : v, this.format(v, step)]);
      }
      return out;
    }
    format(v, step) {
      if (this.kind === "date") return new Date(v * 864e5).toISOString().slice(0, step < 1 ? 16 : 10).replace("T", " ");
      const digits = Math.max(0, Math.min(9, -Math.floor(Math.log10(step) + 1e-9)));
      return v.toFixed(digits).replace("-", "\u2212");
    }
    // a value with as many digits as a pixel is worth
    print(u) {
      const v = this.value(u), near = this.value(u + (this.high - this.low) / 2000);
      return this.format(v, Math.abs(near - v) || 1e-9);
    }
  }

  const splitLabel = text => {
    const found = /^([^]*?)\s*\[([^\]]*)\]\s*$/.exec(text.trim());
    return found ? [found[1].replace(/\s+/g, " "), found[2]] : [text.trim().replace(/\s+/g, " "), ""];
  };

  class Panel {
    constructor(figure, note) {
      this.figure = figure;
      this.note = note;
      this.group = figure.svg.getElementById(note.id);
      const [x0, top, x1, bottom] = note.box;
      Object.assign(this, {x0, x1, top, bottom});
      this.x = new Axis(note.x, note.kinds[0], x0, x1);
      this.y = new Axis(note.y, note.kinds[1], bottom, top);
      this.parts = null;
      this.cursor = make("line", {y1: top, y2: bottom, stroke: "#57606a", "stroke-width": 0.7, "stroke-dasharray": "3 2",
                                  visibility: "hidden", "pointer-events": "none"}, figure.svg);
    }
    contains(p) { return p.x >= this.x0 && p.x <= this.x1 && p.y >= this.top && p.y <= this.bottom; }

    // what moves with the axes: each part has a function that moves it by [a, b] in x and [c, d] in y
    find() {
      if (this.parts) return;
      this.parts = [];
      for (const e of [...this.group.querySelectorAll("[clip-path]")]) {
        if (e.closest("[id^='matplotlib.axis']") || e.closest("[id^='legend']")) continue;
        if (e.tagName === "g") { for (const child of [...e.children]) this.add(child); continue; }
        const shield = make("g", {"clip-path": e.getAttribute("clip-path")});
        e.removeAttribute("clip-path");
        e.replaceWith(shield);
        shield.append(e);
        this.add(e);
      }
      for (const id of this.note.texts) {
        const e = this.figure.svg.getElementById(id)?.querySelector("text");
        if (e && !e.closest("[clip-path]")) this.addText(e, true);
      }
      this.old = {x: [...this.group.querySelectorAll("[id^='xtick']")], y: [...this.group.querySelectorAll("[id^='ytick']")]};
      this.layer = make("g", {});
      this.group.children[0].after(this.layer);
    }
    add(e) {
      if (e.tagName === "text") return this.addText(e, false);
      const x = +e.getAttribute("x") || 0, y = +e.getAttribute("y") || 0;
      const isMarker = e.tagName === "use" && !(x === 0 && Math.abs(y - this.figure.height) < 1);
      if (isMarker) return this.parts.push(([a, b], [c, d]) => { e.setAttribute("x", a * x + b); e.setAttribute("y", c * y + d); });
      const drawn = e.tagName === "use" ? this.figure.svg.querySelector(e.getAttribute("xlink:href")) : e;
      drawn?.setAttribute("vector-effect", "non-scaling-stroke");
      const before = e.getAttribute("transform") || "";
      this.parts.push(([a, b], [c, d]) => e.setAttribute("transform", `matrix(${a} 0 0 ${c} ${b} ${d}) ${before}`));
    }
    addText(e, hides) {
      const before = e.getAttribute("transform") || "", at = e.getBBox(), x = at.x, y = at.y + at.height / 2;
      this.parts.push(([a, b], [c, d]) => {
        const dx = (a - 1) * x + b, dy = (c - 1) * y + d;
        e.setAttribute("transform", `translate(${dx} ${dy}) ${before}`);
        if (hides) e.style.display = x + dx < this.x0 - 1 || x + dx > this.x1 || y + dy < this.top - 1 || y + dy > this.bottom + 1 ? "none" : "";
      });
    }
    draw() {
      if (!this.parts && !this.x.zoomed && !this.y.zoomed) return;
      this.find();
      for (const move of this.parts) move(this.x.move, this.y.move);
      this.layer.replaceChildren();
      this.drawTicks("x", this.x);
      this.drawTicks("y", this.y);
    }
    drawTicks(name, axis) {
      const old = this.old[name], across = name === "x";
      for (const e of old) e.style.display = axis.zoomed ? "none" : "";
      const text = old.map(e => e.querySelector("text")).find(Boolean);
      if (!axis.zoomed || axis.kind === "names" || !old.length) return;
      const length = Math.abs(axis.end - axis.start);
      for (const [u, words] of axis.ticks(Math.max(2, across ? length / (axis.kind === "date" ? 85 : 60) : length / 22))) {
        const at = axis.place(u);
        make("line", across ? {x1: at, x2: at, y1: this.top, y2: this.bottom} : {y1: at, y2: at, x1: this.x0, x2: this.x1},
             this.layer).setAttribute("stroke", "#e4e7eb");
        if (!text) continue;
        const label = make("text", across ? {x: at, y: this.bottom + 15} : {x: this.x0 - 7, y: at + 3}, this.layer);
        label.setAttribute("style", text.getAttribute("style"));
        label.style.textAnchor = across ? "middle" : "end";
        label.textContent = words;
      }
    }
    // points of each line as drawn with the full limits: [x, y, whether a stroke leads to it]; lines that turn back have none
    get curves() {
      return this.known ??= this.note.lines.map(([id, label]) => {
        const d = this.figure.svg.getElementById(id)?.querySelector("path")?.getAttribute("d") || "";
        const points = [...d.matchAll(/([ML])\s*(-?[\d.e+-]+)[ ,]+(-?[\d.e+-]+)/g)]
          .map(m => [+m[2], +m[3], m[1] === "L"]);
        return {label, points: points.every((p, i) => !i || p[0] >= points[i - 1][0]) ? points : []};
      }).filter(curve => curve.points.length);
    }
    // [name, value with unit] of each line at the cursor
    readValues(u) {
      const [name, unit] = splitLabel(this.note.ylabel), [a, b] = this.x.move, at = (this.x.place(u) - b) / a;
      const out = [];
      for (const {label, points} of this.curves) {
        let low = 0, high = points.length - 1;
        while (high - low > 1) { const mid = (low + high) >> 1; if (points[mid][0] < at) low = mid; else high = mid; }
        const [p, q] = [points[low], points[high]];
        if (at < p[0] || at > q[0] || !q[2]) continue; // beyond the line, or in a gap of it
        const y = q[0] > p[0] ? p[1] + (at - p[0]) / (q[0] - p[0]) * (q[1] - p[1]) : q[1];
        out.push([label || name, `${this.y.print(this.y.readFull(y))} ${unit}`.trim()]);
      }
      return out;
    }
  }

  class Figure {
    constructor(svg) {
      this.svg = svg;
      this.height = svg.viewBox.baseVal.height;
      this.panels = JSON.parse(svg.dataset.axes).map(note => new Panel(this, note));
      this.drag = null;
      this.mark = make("rect", {fill: "#1f6feb", opacity: 0.15, visibility: "hidden", "pointer-events": "none"}, svg);
      svg.style.touchAction = "pan-y";
      const on = (name, act, options) => svg.addEventListener(name, act.bind(this), options);
      on("pointermove", this.move); on("pointerdown", this.press); on("pointerup", this.release);
      on("pointerleave", this.leave); on("dblclick", this.reset); on("wheel", this.turn, {passive: false});
    }
    locate(event) {
      const p = this.svg.createSVGPoint();
      [p.x, p.y] = [event.clientX, event.clientY];
      return p.matrixTransform(this.svg.getScreenCTM().inverse());
    }
    find(p) { return this.panels.find(panel => panel.contains(p)); }
    siblings(panel) { return this.panels.filter(other => other.note.group === panel.note.group); }
    draw() { for (const panel of this.panels) panel.draw(); }

    move(event) {
      const p = this.locate(event), panel = this.drag?.panel || this.find(p);
      for (const other of this.panels) other.cursor.setAttribute("visibility", "hidden");
      box.style.display = "none";
      if (!panel) return;
      if (this.drag) {
        const [x0, x1] = [this.drag.x, Math.min(Math.max(p.x, panel.x0), panel.x1)].sort((a, b) => a - b);
        const tall = this.isTall(p), [y0, y1] = tall ? [this.drag.y, Math.min(Math.max(p.y, panel.top), panel.bottom)].sort((a, b) => a - b) : [panel.top, panel.bottom];
        for (const [key, value] of Object.entries({x: x0, y: y0, width: x1 - x0, height: y1 - y0, visibility: "visible"})) this.mark.setAttribute(key, value);
        return;
      }
      this.show(panel, p, event);
    }
    show(panel, p, event) {
      const u = panel.x.read(p.x), rows = [], [name, unit] = splitLabel(panel.note.xlabel || this.siblings(panel).map(o => o.note.xlabel).find(Boolean) || "x");
      if (panel.x.kind !== "names") rows.push([name.split(";")[0], `${panel.x.print(u)} ${unit}`.trim()]);
      const others = this.siblings(panel);
      for (const other of others.length > 1 ? others : [panel]) {
        other.cursor.setAttribute("x1", p.x - panel.x0 + other.x0); other.cursor.setAttribute("x2", p.x - panel.x0 + other.x0);
        other.cursor.setAttribute("visibility", "visible");
        if (other.x.kind !== "names") rows.push(...other.readValues(u));
      }
      if (rows.length < 2 && panel.y.kind !== "names") {
        const [words, of] = splitLabel(panel.note.ylabel || "y");
        rows.push([words, `${panel.y.print(panel.y.read(p.y))} ${of}`.trim()]);
      }
      box.replaceChildren(...rows.map(([words, value]) => {
        const row = document.createElement("div"), left = document.createElement("span"), right = document.createElement("b");
        left.textContent = words; right.textContent = value;
        row.append(left, right);
        return row;
      }));
      box.style.display = "block";
      const wide = box.offsetWidth, right = event.clientX + 18 + wide < document.documentElement.clientWidth;
      box.style.left = `${right ? event.clientX + 18 : Math.max(4, event.clientX - 18 - wide)}px`;
      box.style.top = `${Math.min(event.clientY + 14, innerHeight - box.offsetHeight - 6)}px`;
    }
    press(event) {
      const p = this.locate(event), panel = this.find(p);
      if (!panel || event.button || event.pointerType === "touch") return;
      this.drag = {panel, x: p.x, y: p.y};
      this.svg.setPointerCapture(event.pointerId);
      event.preventDefault();
    }
    isTall(p) { return Math.abs(p.y - this.drag.y) > 0.25 * (this.drag.panel.bottom - this.drag.panel.top) && this.drag.panel.y.kind !== "names"; }
    release(event) {
      if (!this.drag) return;
      const p = this.locate(event), {panel, x, y} = this.drag, tall = this.isTall(p);
      this.mark.setAttribute("visibility", "hidden");
      if (Math.abs(p.x - x) > 4) {
        const [a, b] = [panel.x.read(x), panel.x.read(p.x)].sort((i, j) => i - j);
        for (const other of this.siblings(panel)) if (other.x.kind !== "names") other.x.set(a, b);
      }
      if (tall) {
        const [a, b] = [panel.y.read(Math.max(y, p.y)), panel.y.read(Math.min(y, p.y))];
        panel.y.set(a, b);
      }
      this.drag = null;
      this.draw();
    }
    leave() {
      box.style.display = "none";
      for (const panel of this.panels) panel.cursor.setAttribute("visibility", "hidden");
    }
    turn(event) {
      if (!event.ctrlKey && !event.shiftKey) return; // the plain wheel scrolls the page
      const p = this.locate(event), panel = this.find(p), by = (event.deltaY || event.deltaX) > 0 ? 1.25 : 0.8;
      if (!panel) return;
      event.preventDefault();
      const zoom = (axis, at) => { if (axis.kind !== "names") axis.set(at + (axis.low - at) * by, at + (axis.high - at) * by); };
      if (event.shiftKey) zoom(panel.y, panel.y.read(p.y));
      else { const at = panel.x.read(p.x); for (const other of this.siblings(panel)) zoom(other.x, at); }
      this.draw();
    }
    reset() {
      for (const panel of this.panels) { panel.x.reset(); panel.y.reset(); }
      this.draw();
    }
  }

  const figures = [...document.querySelectorAll("svg[data-axes]")].map(svg => new Figure(svg));
  addEventListener("scroll", () => { box.style.display = "none"; }, {passive: true});
  addEventListener("beforeprint", () => figures.forEach(figure => figure.leave()));
})();
