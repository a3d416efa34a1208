// The table of a run to look at: a scatter, parallel coordinates, the values of a row, its trace.
// Texts come from people, so that they are only ever put in as text.
function view(root, data, ask) {
  "use strict";
  const shown = data.groups.map(() => true);
  const count = data.rows.length;
  const state = { hovered: -1, selected: -1 };

  function make(tag, attributes, ...children) {
    const node = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes || {})) {
      if (name === "class") node.className = value;
      else node.setAttribute(name, value);
    }
    node.append(...children);
    return node;
  }

  function drawn(tag, attributes, text) {
    const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
    if (text !== undefined) node.textContent = text;
    return node;
  }

  function written(column, value) {
    if (value === null) return "absent";
    return column.levels ? column.levels[value] : String(value);
  }

  // The place of a value on the axis of its column, from 0 to 1.
  const scales = data.columns.map((column) => {
    if (column.levels) {
      const last = Math.max(column.levels.length - 1, 1);
      return { at: (v) => (column.levels.length > 1 ? v / last : 0.5), low: 0, high: last };
    }
    let low = Infinity, high = -Infinity;
    for (const value of column.values) {
      if (value === null) continue;
      if (value < low) low = value;
      if (value > high) high = value;
    }
    if (!(low < high)) return { at: () => 0.5, low, high: low };
    if (low > 0 && high / low > 1000) {
      const span = Math.log(high / low);
      return { at: (v) => Math.log(v / low) / span, low, high };
    }
    return { at: (v) => (v - low) / (high - low), low, high };
  });

  function place(column, row) {
    const value = data.columns[column].values[row];
    return value === null ? null : scales[column].at(value);
  }

  function ends(column) {
    const { levels } = data.columns[column];
    if (levels) return [levels[0], levels[levels.length - 1]];
    const short = (v) => (Number.isFinite(v) ? String(Number(v.toPrecision(3))) : "");
    return [short(scales[column].low), short(scales[column].high)];
  }

  // Elements.
  const across = make("select", { "aria-label": "feature across" });
  const up = make("select", { "aria-label": "feature upwards" });
  data.columns.forEach((column, i) => {
    for (const select of [across, up]) select.append(make("option", { value: i }, column.name));
  });
  across.value = data.axes[0];
  up.value = data.axes[1];
  const known = make("select", { "aria-label": "row with a trace" });
  known.append(make("option", { value: "" }, "choose a row"));
  for (const row of Object.keys(data.traces)) {
    known.append(make("option", { value: row }, data.traces[row].label));
  }
  const legend = make("div", { class: "vj-legend" });
  data.groups.forEach((group, i) => {
    const box = make("input", { type: "checkbox" });
    box.checked = true;
    box.addEventListener("change", () => { shown[i] = box.checked; draw(); });
    const mark = drawn("svg", { width: 12, height: 12, "aria-hidden": "true" });
    mark.append(drawn("circle", { cx: 6, cy: 6, r: 5, fill: group.color }));
    legend.append(make("label", {}, box, " ", mark, ` ${group.name} (${group.count})`));
  });
  const scatter = make("canvas", { class: "vj-scatter", role: "img", "aria-label": "scatter of rows" });
  const lines = make("canvas", { class: "vj-parallel", role: "img", "aria-label": "parallel coordinates of rows" });
  const details = make("div", { class: "vj-details", "aria-live": "polite" }, "Point at a row to see its values; click it for its trace.");
  const trace = make("div", { class: "vj-trace" });
  const tools = make("div", { class: "vj-tools" },
    make("label", {}, "across ", across), make("label", {}, "upwards ", up),
    make("label", {}, "rows with a trace ", known));
  root.append(tools, legend,
    make("div", { class: "vj-columns" }, scatter, make("div", { class: "vj-side" }, details, trace)), lines);

  // Drawing.
  function context(canvas) {
    const ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.font = "12px system-ui, sans-serif";
    return [pen, width, height];
  }

  const left = 52, bottom = 34, top = 10, right = 10;
  function scatterPlace(row, width, height) {
    const x = place(Number(across.value), row), y = place(Number(up.value), row);
    if (x === null || y === null) return null;
    return [left + x * (width - left - right), height - bottom - y * (height - top - bottom)];
  }

  function drawScatter() {
    const [pen, width, height] = context(scatter);
    pen.strokeStyle = "#c9ccd6";
    pen.strokeRect(left, top, width - left - right, height - top - bottom);
    pen.fillStyle = "#30323d";
    const [x0, x1] = ends(Number(across.value)), [y0, y1] = ends(Number(up.value));
    pen.textAlign = "left"; pen.fillText(x0, left, height - 18);
    pen.textAlign = "right"; pen.fillText(x1, width - right, height - 18);
    pen.fillText(y0, left - 4, height - bottom); pen.fillText(y1, left - 4, top + 10);
    pen.textAlign = "center";
    pen.fillText(data.columns[Number(across.value)].name, left + (width - left - right) / 2, height - 4);
    pen.save();
    pen.translate(12, top + (height - top - bottom) / 2);
    pen.rotate(-Math.PI / 2);
    pen.fillText(data.columns[Number(up.value)].name, 0, 0);
    pen.restore();
    for (let group = 0; group < data.groups.length; group += 1) {
      if (!shown[group]) continue;
      pen.fillStyle = data.groups[group].color;
      pen.globalAlpha = group ? 0.8 : 0.45;
      for (let row = 0; row < count; row += 1) {
        if (data.group[row] !== group) continue;
        const at = scatterPlace(row, width, height);
        if (!at) continue;
        pen.beginPath();
        pen.arc(at[0], at[1], group ? 3 : 2, 0, 7);
        pen.fill();
      }
    }
    pen.globalAlpha = 1;
    for (const [row, color] of [[state.hovered, "#30323d"], [state.selected, "#000"]]) {
      const at = row < 0 ? null : scatterPlace(row, width, height);
      if (!at) continue;
      pen.strokeStyle = color;
      pen.lineWidth = 2;
      pen.beginPath(); pen.arc(at[0], at[1], 6, 0, 7); pen.stroke();
      pen.lineWidth = 1;
    }
  }

  const axes = data.parallel;
  function axisPlace(i, width) {
    return axes.length > 1 ? 40 + (i * (width - 80)) / (axes.length - 1) : width / 2;
  }

  function drawLines() {
    const [pen, width, height] = context(lines);
    const reach = height - 70;
    const line = (row) => {
      pen.beginPath();
      let open = false;
      axes.forEach((column, i) => {
        const y = place(column, row);
        if (y === null) { open = false; return; }
        const x = axisPlace(i, width), at = 48 + (1 - y) * reach;
        if (open) pen.lineTo(x, at); else pen.moveTo(x, at);
        open = true;
      });
      pen.stroke();
    };
    for (let group = 0; group < data.groups.length; group += 1) {
      if (!shown[group]) continue;
      pen.strokeStyle = data.groups[group].color;
      pen.globalAlpha = group ? 0.25 : 0.04;
      for (let row = 0; row < count; row += 1) if (data.group[row] === group) line(row);
    }
    pen.globalAlpha = 1;
    for (const row of [state.hovered, state.selected]) {
      if (row < 0) continue;
      pen.strokeStyle = "#000"; pen.lineWidth = 2; line(row); pen.lineWidth = 1;
    }
    pen.fillStyle = "#30323d"; pen.strokeStyle = "#30323d"; pen.textAlign = "center";
    const room = Math.max(width / Math.max(axes.length, 1) - 6, 24);
    axes.forEach((column, i) => {
      const x = axisPlace(i, width), [low, high] = ends(column);
      pen.beginPath(); pen.moveTo(x, 48); pen.lineTo(x, 48 + reach); pen.stroke();
      pen.fillText(data.columns[column].name, x, i % 2 ? 24 : 12, room * 2);
      pen.fillText(low, x, 62 + reach, room);
      pen.fillText(high, x, 42, room);
    });
  }

  function draw() { drawScatter(); drawLines(); }

  // A row found under the pointer.
  function nearestPoint(event) {
    const box = scatter.getBoundingClientRect();
    const x = event.clientX - box.left, y = event.clientY - box.top;
    let best = -1, least = 14 * 14;
    for (let row = 0; row < count; row += 1) {
      if (!shown[data.group[row]]) continue;
      const at = scatterPlace(row, scatter.clientWidth, scatter.clientHeight);
      if (!at) continue;
      const away = (at[0] - x) ** 2 + (at[1] - y) ** 2;
      // Of rows in one place the graver one counts.
      if (away < least || (away === least && best >= 0 && data.group[row] > data.group[best])) {
        best = row; least = away;
      }
    }
    return best;
  }

  function nearestLine(event) {
    const box = lines.getBoundingClientRect();
    const x = event.clientX - box.left, y = event.clientY - box.top;
    const width = lines.clientWidth, reach = lines.clientHeight - 70;
    let i = 0;
    while (i < axes.length - 2 && axisPlace(i + 1, width) < x) i += 1;
    let best = -1, least = 8;
    for (let row = 0; row < count; row += 1) {
      if (!shown[data.group[row]]) continue;
      const from = place(axes[i], row), to = axes.length > 1 ? place(axes[i + 1], row) : from;
      if (from === null || to === null) continue;
      const begin = axisPlace(i, width);
      const share = axes.length > 1 ? (x - begin) / (axisPlace(i + 1, width) - begin) : 0;
      const away = Math.abs(48 + (1 - (from + share * (to - from))) * reach - y);
      if (away < least) { best = row; least = away; }
    }
    return best;
  }

  function show(row) {
    const body = make("tbody", {});
    const line = (name, value) => body.append(
      make("tr", {}, make("th", { scope: "row" }, name), make("td", {}, value)));
    line("row", String(data.rows[row]));
    line("verdict", data.groups[data.group[row]].name);
    for (const column of data.columns) line(column.name, written(column, column.values[row]));
    details.replaceChildren(make("table", {}, body));
    root.dataset.row = data.rows[row];
  }

  function hover(row) {
    if (row === state.hovered) return;
    state.hovered = row;
    const about = row >= 0 ? row : state.selected;
    if (about >= 0) show(about);
    draw();
  }

  function select(row) {
    if (row < 0) return;
    state.selected = row;
    show(row);
    showTrace(data.rows[row]);
    draw();
  }

  function showTrace(number) {
    const found = data.traces[number];
    root.dataset.selected = number;
    known.value = found ? String(number) : "";
    if (found) { plot(found); return; }
    trace.replaceChildren();
    if (ask) {
      trace.append(make("p", {}, `Row ${number} is being simulated.`));
      ask(number);
    } else {
      trace.append(make("p", {}, `Row ${number} was not simulated beforehand. ${data.replay}`),
        ...(data.command ? [make("pre", {}, `${data.command} ${number}`)] : []));
    }
  }

  function plot(found) {
    trace.replaceChildren(make("p", {}, found.text));
    if (!found.time.length) return;
    const width = 420, height = 104, first = found.time[0], last = found.time[found.time.length - 1];
    const x = (t) => 46 + ((t - first) / Math.max(last - first, 1e-12)) * (width - 56);
    found.signals.forEach((signal, place) => {
      const all = signal.values.flat().filter((v) => v !== null);
      const reach = Math.max(...all.map(Math.abs), 1e-12);
      const bounds = signal.bounds.filter((b) => Math.abs(b) <= 4 * reach);
      let low = Math.min(...all, ...bounds), high = Math.max(...all, ...bounds);
      if (!(low < high)) { low -= 0.5; high += 0.5; }
      const y = (v) => 20 + (1 - (v - low) / (high - low)) * (height - 40);
      const svg = drawn("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": signal.name });
      svg.append(drawn("text", { x: 46, y: 12, "font-size": 11 }, signal.name));
      svg.append(drawn("text", { x: 42, y: 28, "font-size": 10, "text-anchor": "end" }, Number(high.toPrecision(3))));
      svg.append(drawn("text", { x: 42, y: height - 20, "font-size": 10, "text-anchor": "end" }, Number(low.toPrecision(3))));
      svg.append(drawn("rect", { x: 46, y: 20, width: width - 56, height: height - 40, fill: "none", stroke: "#c9ccd6" }));
      for (const bound of bounds) {
        svg.append(drawn("line", { x1: 46, x2: width - 10, y1: y(bound), y2: y(bound), stroke: "#30323d", "stroke-dasharray": "5 3" }));
      }
      if (found.instant !== null) {
        svg.append(drawn("line", { x1: x(found.instant), x2: x(found.instant), y1: 20, y2: height - 20, stroke: "#d1495b", "stroke-dasharray": "2 2" }));
      }
      for (const values of signal.values) {
        const points = values.map((v, i) => (v === null ? null : `${x(found.time[i]).toFixed(1)},${y(v).toFixed(1)}`));
        svg.append(drawn("polyline", { points: points.filter(Boolean).join(" "), fill: "none", stroke: "#4f6d9c", "stroke-width": 1.5 }));
      }
      if (place === found.signals.length - 1) {
        svg.append(drawn("text", { x: 46, y: height - 5, "font-size": 10 }, `${Number(first.toPrecision(3))} s`));
        svg.append(drawn("text", { x: width - 10, y: height - 5, "font-size": 10, "text-anchor": "end" }, `${Number(last.toPrecision(4))} s`));
      }
      trace.append(svg);
    });
  }

  scatter.addEventListener("pointermove", (event) => hover(nearestPoint(event)));
  scatter.addEventListener("pointerleave", () => hover(-1));
  scatter.addEventListener("click", (event) => select(nearestPoint(event)));
  lines.addEventListener("pointermove", (event) => hover(nearestLine(event)));
  lines.addEventListener("pointerleave", () => hover(-1));
  lines.addEventListener("click", (event) => select(nearestLine(event)));
  across.addEventListener("change", draw);
  up.addEventListener("change", draw);
  known.addEventListener("change", () => {
    if (known.value !== "") select(data.rows.indexOf(Number(known.value)));
  });
  new ResizeObserver(draw).observe(root);
  draw();
  return {
    answer(number, found) {
      data.traces[number] = found;
      if (String(number) === root.dataset.selected) plot(found);
    },
  };
}
