"use strict";
// Draws the figures, follows light, dark and paper, and lets tables be sorted. What can be asked from outside:
// `reportDrawn` is true once every figure has been drawn, but for what waits until it is looked at; `drawAll()` draws
// what is left and promises to be done.
(() => {
  const root = document.documentElement;
  const PRINT_WIDTH = 680; // of A4 within its margins, in pixels of CSS
  const HIGHEST = 540, HIGHEST_ON_PAPER = 620; // of the room inside the axes; a map is as wide as the page
  const COLOURS = ["ink", "muted", "grid", "paper", "blue", "step-1", "step-2", "step-3", "step-4"];
  // named one by one, since Plotly's own choice has a button that sends the figure to a server
  const BUTTONS = ["toImage", "zoom2d", "pan2d", "zoomIn2d", "zoomOut2d", "resetScale2d"];
  const BUTTONS_IN_SPACE = ["toImage", "zoom3d", "pan3d", "orbitRotation", "tableRotation", "resetCameraDefault3d"];
  const COLOUR_KEY = /color$/i;
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const roomy = matchMedia("(min-width: 1100px)");
  const touch = matchMedia("(pointer: coarse)");
  let chosen = null;
  try { chosen = localStorage.getItem("report-theme"); } catch { /* a file may have no storage */ }
  let isPrinting = false;
  window.reportDrawn = false;

  // the look: the reader's choice, else the system's; paper is light
  const theme = () => (isPrinting ? "light" : chosen ?? (dark.matches ? "dark" : "light"));
  function applyTheme() {
    if (root.dataset.theme === theme()) return false;
    root.dataset.theme = theme();
    return true;
  }
  applyTheme();

  const figures = [...document.querySelectorAll("figure")].map((element) => ({
    element, plot: element.querySelector(".plot"), text: element.querySelector("script").textContent,
    parts: null, mode: 0, drawn: null, width: 0,
  }));

  // `@ink` and the like become the page's colours; only where a colour is expected, since a photo may be named so
  function coloured(value, key, colours) {
    if (typeof value === "string") return value[0] === "@" && COLOUR_KEY.test(key) ? colours[value] : value;
    if (Array.isArray(value)) {
      return typeof value[0] === "object" && value[0] !== null ? value.map((one) => coloured(one, key, colours)) : value;
    }
    if (value === null || typeof value !== "object" || ArrayBuffer.isView(value)) return value;
    return Object.fromEntries(Object.entries(value).map(([name, one]) => [name, coloured(one, name, colours)]));
  }

  // whether WebGL has no graphics card, and computes each pixel
  function isSoftware() {
    const gl = document.createElement("canvas").getContext("webgl");
    const info = gl?.getExtension("WEBGL_debug_renderer_info");
    const name = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
    gl?.getExtension("WEBGL_lose_context")?.loseContext();
    return /swiftshader|llvmpipe|software|basic render/i.test(name);
  }

  // data and layout for the width that there is now
  function prepared(figure) {
    const style = getComputedStyle(root);
    const colours = {};
    for (const name of COLOURS) colours[`@${name}`] = style.getPropertyValue(`--${name}`).trim();
    const { data, layout, ratio, height, modes } = figure.parts;
    const traces = coloured(data, "", colours);
    if (modes.length) traces[0].marker = coloured(modes[figure.mode].marker, "", colours);
    const made = coloured(layout, "", colours);
    figure.width = isPrinting ? PRINT_WIDTH : figure.plot.clientWidth;
    const isNarrow = figure.width < 560;
    made.width = figure.width;
    made.font = { ...made.font, family: getComputedStyle(document.body).fontFamily, size: isNarrow ? 11 : 12 };
    made.hoverlabel = { ...made.hoverlabel, bgcolor: colours["@paper"], bordercolor: colours["@muted"], font: { color: colours["@ink"] } };
    made.modebar = { bgcolor: "rgba(0,0,0,0)", color: colours["@muted"], activecolor: colours["@ink"] };
    if (touch.matches && !made.scene) made.dragmode = false; // a finger scrolls the page
    // labels, a colour bar and the legend take about so much beside the axes
    const beside = traces.some((trace) => trace.colorbar || trace.marker?.colorbar) ? 150 : 70;
    const entries = traces.filter((trace) => trace.showlegend !== false && trace.type !== "heatmap");
    const length = entries.reduce((sum, trace) => sum + 50 + 7 * (trace.name ?? "").length, 0);
    const legend = entries.length < 2 ? 0 : 12 + 20 * Math.ceil(length / (figure.width - beside));
    if (made.scene) {
      made.height = isPrinting ? 380 : Math.min(height, Math.round(figure.width * 0.9));
      if (isNarrow || isPrinting) for (const axis of "xyz") made.scene.camera.eye[axis] *= isPrinting ? 1.35 : 1.2;
    } else if (height) {
      made.height = Math.round(height * (isPrinting ? 0.85 : 1)) + (isNarrow ? legend : 0);
    } else {
      const inside = Math.min((figure.width - beside) * ratio, isPrinting ? HIGHEST_ON_PAPER : HIGHEST);
      made.height = Math.round(inside + 75 + legend);
      const shrink = Math.max(0.6, Math.min(1, inside / HIGHEST)); // small maps have small markers and thin lines
      for (const { marker, line } of traces) {
        if (marker) marker.size *= shrink;
        if (line) line.width *= shrink;
      }
      made.yaxis.nticks = Math.max(2, Math.min(6, Math.floor(inside / 80))); // turned labels need their length
    }
    if (isNarrow) traces.forEach((trace) => delete trace.texttemplate); // there is no room for numbers in cells
    return [traces, made];
  }

  // lines between places: the page has their numbers alone, since a block of 500 photos has 10,000 pairs
  const TYPES = { f8: Float64Array, u4: Uint32Array, u2: Uint16Array };
  function unpacked({ dtype, bdata }) {
    return new TYPES[dtype](Uint8Array.from(atob(bdata), (letter) => letter.charCodeAt(0)).buffer);
  }
  function joinPlaces({ data, places }) {
    if (!places) return;
    const xy = unpacked(places);
    for (const trace of data) {
      if (!trace.ends) continue;
      const ends = unpacked(trace.ends);
      delete trace.ends;
      for (const [axis, letter] of ["x", "y"].entries()) {
        trace[letter] = new Float64Array(1.5 * ends.length).fill(NaN); // a gap after each line
        for (let k = 0; k < ends.length; k += 1) trace[letter][k + (k >> 1)] = xy[2 * ends[k] + axis];
      }
    }
  }

  function draw(figure) {
    figure.drawn ??= (async () => {
      try {
        figure.parts = JSON.parse(figure.text);
        joinPlaces(figure.parts);
        const [traces, layout] = prepared(figure);
        await Plotly.newPlot(figure.plot, traces, layout, {
          displaylogo: false, responsive: false, displayModeBar: touch.matches ? false : "hover",
          modeBarButtons: [layout.scene ? BUTTONS_IN_SPACE : BUTTONS], plotlyServerURL: "",
          plotGlPixelRatio: layout.scene && isSoftware() ? 1 : 2,
          toImageButtonOptions: { filename: figure.element.id.slice(2), scale: 2 },
        });
      } catch (error) {
        figure.plot.textContent = "This figure could not be drawn.";
        console.error(`${figure.element.id}: ${error.stack ?? error}`);
      }
    })();
    return figure.drawn;
  }
  const redraw = (figure) => figure.parts && Plotly.react(figure.plot, ...prepared(figure));
  const redrawAll = () => figures.forEach(redraw);

  window.drawAll = () => Promise.all(figures.map(draw));

  // figures near the window first, then the others one by one while the reader reads
  const near = new IntersectionObserver((entries) => {
    for (const entry of entries) if (entry.isIntersecting) draw(figures.find((figure) => figure.plot === entry.target));
  }, { rootMargin: "600px" });
  figures.forEach((figure) => near.observe(figure.plot));
  const pause = () => new Promise((resolve) => setTimeout(resolve, 5));
  addEventListener("load", async () => {
    await pause();
    for (const figure of figures) {
      // the points in space take some 3 s without a graphics card, and nothing else moves meanwhile
      if (figure.element.id === "f-space" && isSoftware()) continue;
      await draw(figure);
      await pause();
    }
    window.reportDrawn = true;
    root.dataset.drawn = "true";
  });

  let resizing = 0;
  addEventListener("resize", () => {
    clearTimeout(resizing);
    resizing = setTimeout(() => figures.filter((figure) => figure.width !== figure.plot.clientWidth).forEach(redraw), 120);
  });
  figures.forEach((figure) => {
    const buttons = [...figure.element.querySelectorAll(".modes button")];
    buttons.forEach((button, number) => button.addEventListener("click", async () => {
      figure.mode = number;
      buttons.forEach((one) => one.setAttribute("aria-pressed", String(one === button)));
      await draw(figure);
      redraw(figure);
    }));
  });

  document.querySelector(".theme").addEventListener("click", () => {
    chosen = theme() === "dark" ? "light" : "dark";
    try { localStorage.setItem("report-theme", chosen); } catch { /* the choice holds until the page is closed */ }
    if (applyTheme()) redrawAll();
  });
  dark.addEventListener("change", () => { if (applyTheme()) redrawAll(); });

  // paper: everything open, light, as wide as a page
  let opened = [];
  addEventListener("beforeprint", () => {
    isPrinting = true;
    applyTheme();
    opened = [...document.querySelectorAll("main details:not([open])")];
    opened.forEach((details) => { details.open = true; });
    figures.forEach((figure) => (figure.parts ? redraw(figure) : draw(figure)));
  });
  addEventListener("afterprint", () => {
    isPrinting = false;
    applyTheme();
    opened.forEach((details) => { details.open = false; });
    redrawAll();
  });

  // contents: the section that is read
  const contents = document.querySelector(".contents details");
  const here = document.querySelector(".here");
  const links = new Map([...contents.querySelectorAll("a")].map((link) => [link.hash.slice(1), link]));
  const unfold = () => { contents.open = roomy.matches; };
  unfold();
  roomy.addEventListener("change", unfold);
  contents.addEventListener("click", (event) => { if (event.target.closest("a") && !roomy.matches) contents.open = false; });
  const passing = new IntersectionObserver(() => {
    const line = innerHeight / 3;
    const passed = [...document.querySelectorAll("main > section")].filter((one) => one.getBoundingClientRect().top < line);
    const current = passed.length ? links.get(passed[passed.length - 1].id) : null;
    links.forEach((link) => link.toggleAttribute("aria-current", link === current));
    here.textContent = current ? `Contents: ${current.textContent}` : "Contents";
  }, { rootMargin: "0px 0px -66% 0px" });
  document.querySelectorAll("main > section").forEach((section) => passing.observe(section));

  // tables: a click on a heading sorts by it, a second one the other way round; what is unknown comes last
  const words = new Intl.Collator("en", { numeric: true });
  const value = (cell, isText) => (isText ? cell.textContent.trim() : Number(cell.textContent.replace(/,/g, "") || NaN));
  function compare(a, b, isText) {
    if (isText) return words.compare(a, b);
    return a - b;
  }
  document.querySelectorAll("table").forEach((table) => table.tHead.addEventListener("click", (event) => {
    const heading = event.target.closest("th");
    if (!heading) return;
    const sign = heading.getAttribute("aria-sort") === "ascending" ? -1 : 1;
    const isText = heading.classList.contains("t");
    for (const other of heading.parentElement.cells) other.removeAttribute("aria-sort");
    heading.setAttribute("aria-sort", sign > 0 ? "ascending" : "descending");
    const body = table.tBodies[0];
    const rows = [...body.rows].map((row) => [value(row.cells[heading.cellIndex], isText), row]);
    const isKnown = ([key]) => (isText ? key !== "–" : !Number.isNaN(key));
    const known = rows.filter(isKnown).sort(([a], [b]) => sign * compare(a, b, isText));
    body.append(...[...known, ...rows.filter((row) => !isKnown(row))].map(([, row]) => row));
  }));
})();
