"use strict";
(() => {
  const index = JSON.parse(document.getElementById("index").textContent);
  const at = (id) => document.getElementById(id);
  const SHARP = 2; // canvases have so many pixels for one of the video, so that lines stay fine on large screens
  const ARMS = [["left", "#e6007e"], ["right", "#00a651"]];
  const layers = { mask: false, flow: false, keypoints: false, contacts: false };
  const scripts = new Map(); // scenes that were read, by number
  const film = document.createElement("video");
  film.muted = film.playsInline = film.loop = true;
  film.preload = "auto";
  let current = -1, scene = null, chosen = null, views = [], frame = 0, wanted = 0;

  // --- The document: all texts are set as text.

  function make(parent, tag, text = "", kind = "") {
    const element = parent.appendChild(document.createElement(tag));
    element.textContent = text;
    if (kind) element.className = kind;
    return element;
  }

  const ROWS = ["video", "flow", "prediction", "difference"];

  function picture(parent, title, size, row) {
    const line = make(parent, "div", "", "label");
    make(line, "span", title);
    const value = make(line, "span");
    const canvas = make(parent, "canvas");
    [canvas.width, canvas.height] = size.map((pixels) => SHARP * pixels);
    canvas.setAttribute("role", "img");
    return { canvas, value, row, line };
  }

  function build() {
    const several = chosen.rows.includes("prediction");
    at("robots").replaceChildren();
    views = scene.robots.map((robot, column) => {
      const figure = make(at("robots"), "figure");
      make(figure, "h2", robot.title);
      const view = { robot, column, figure, pictures: [picture(figure, several ? "truth" : "", robot.size, "video")], psnr: chosen.psnr[column] };
      view.pictures[0].canvas.setAttribute("aria-label", `Video of ${robot.title}`);
      for (const row of chosen.rows.filter((name) => !ROWS.includes(name))) { // other cameras
        const one = picture(figure, row, robot.size, row);
        one.canvas.setAttribute("aria-label", `View ${row} of ${robot.title}`);
        view.pictures.push(one);
      }
      if (view.psnr) {
        for (const row of ["prediction", "difference"]) {
          const one = picture(figure, row, robot.size, row);
          one.canvas.setAttribute("aria-label", `${row} of ${robot.title}`);
          view.pictures.push(one);
        }
        view.curve = picture(figure, "PSNR", [robot.size[0], 56], "");
        view.curve.canvas.setAttribute("aria-label", `PSNR by frame of ${robot.title}: ${summary(view.psnr)}`);
      } else if (several) make(figure, "p", "not predicted", "info");
      view.spans = picture(figure, "contacts", [robot.size[0], 12 * Math.max(1, rowsOf(robot).length)], "");
      view.spans.canvas.setAttribute("aria-label", describe(robot));
      view.spans.canvas.title = describe(robot);
      return view;
    });
    for (const { figure, psnr } of views) if (psnr) figure.style.order = -1; // predicted robots come first
    const has = {
      mask: scene.robots.some((robot) => robot.outlines), flow: chosen.rows.includes("flow"),
      keypoints: scene.robots.some((robot) => robot.keypoints), contacts: scene.robots.some((robot) => robot.contacts),
    };
    for (const button of document.querySelectorAll("[data-layer]")) button.disabled = !has[button.dataset.layer];
  }

  const rowsOf = (robot) => [...new Set((robot.contacts || []).map(([arm, thing]) => `${arm} ${thing}`))];

  function describe(robot) {
    const said = (robot.contacts || []).map(
      ([arm, thing, first, last]) => `${ARMS[arm][0]} hand touches ${robot.things[thing]} in frames ${first} to ${last}`);
    return said.length ? said.join("; ") : robot.contacts ? "nothing is touched" : "contacts are not known";
  }

  function summary(values) {
    const found = values.slice(1).filter((value) => value !== null);
    return found.length ? `mean ${(found.reduce((a, b) => a + b, 0) / found.length).toFixed(1)} dB` : "exact";
  }

  // --- Drawing.

  function draw() {
    if (!scene || film.readyState < 2) return;
    for (const view of views) {
      for (const one of view.pictures) drawPicture(view, one);
      drawSpans(view);
      if (view.curve) drawCurve(view);
    }
    at("robots").dataset.frame = frame;
  }

  function drawPicture(view, one) {
    const { robot, column } = view, context = one.canvas.getContext("2d"), [width, height] = robot.size;
    const tile = (row) => context.drawImage(
      film, column * chosen.tile[0], chosen.rows.indexOf(row) * chosen.tile[1], width, height, 0, 0, width, height);
    context.setTransform(SHARP, 0, 0, SHARP, 0, 0);
    context.globalCompositeOperation = "source-over";
    tile(one.row);
    const predicted = one.row === "prediction" || one.row === "difference";
    const last = (predicted ? view.psnr.length : robot.frames) - 1;
    one.value.textContent = frame > last ? `ended at frame ${last}` : "";
    if (one.row === "difference" || !ROWS.includes(one.row) || frame > last) return;
    if (layers.flow && chosen.rows.includes("flow")) {
      if (robot.outlines) { // else its colors are lost on dark robots
        trace(context, robot.outlines[frame]);
        context.fillStyle = "rgb(255 255 255 / 65%)";
        context.fill("evenodd");
      }
      context.globalCompositeOperation = "multiply"; // what does not move is white
      tile("flow");
      context.globalCompositeOperation = "source-over";
    }
    if (layers.mask && robot.outlines) drawOutlines(context, robot.outlines[frame]);
    if (layers.keypoints && robot.keypoints) drawKeypoints(context, robot.keypoints[frame]);
    if (layers.contacts && robot.contacts) drawContacts(context, robot);
  }

  function trace(context, outlines) {
    context.beginPath();
    for (const points of outlines) {
      for (let i = 0; i < points.length; i += 2) context[i ? "lineTo" : "moveTo"](points[i] + 0.5, points[i + 1] + 0.5);
      context.closePath();
    }
  }

  function drawOutlines(context, outlines) {
    trace(context, outlines);
    context.lineWidth = 1.2;
    context.strokeStyle = "#ff7800";
    context.stroke();
  }

  function drawKeypoints(context, points) {
    context.lineWidth = 1;
    for (let i = 0; i < points.length; i += 3) {
      if (points[i] === null || points[i + 1] === null) continue;
      context.beginPath();
      context.arc(points[i] + 0.5, points[i + 1] + 0.5, 2.5, 0, 7);
      context.fillStyle = context.strokeStyle = "#00a0ff";
      if (points[i + 2]) context.fill();
      context.strokeStyle = points[i + 2] ? "#ffffff" : "#00a0ff";
      context.stroke();
    }
  }

  function drawContacts(context, robot) {
    context.font = "600 11px system-ui, sans-serif";
    for (const [arm, thing, first, last] of robot.contacts) {
      if (frame < first || frame > last) continue;
      const [name, color] = ARMS[arm], place = robot.objects && robot.objects[frame];
      const known = place && place[2 * thing] !== null;
      const [x, y] = known ? [place[2 * thing] + 0.5, place[2 * thing + 1] + 0.5] : [12, 14 + 14 * arm];
      context.strokeStyle = color;
      context.lineWidth = 2;
      context.beginPath();
      context.arc(x, y, arm ? 10 : 7, 0, 7);
      context.stroke();
      const text = `${name}: ${robot.things[thing]}`, wide = context.measureText(text).width;
      const left = Math.max(2, Math.min(x + 14, robot.size[0] - wide - 4)), top = y + (arm ? 16 : -10);
      context.lineWidth = 3;
      context.strokeStyle = "#ffffff";
      context.strokeText(text, left, top);
      context.fillStyle = color;
      context.fillText(text, left, top);
    }
  }

  const ink = (name) => getComputedStyle(document.documentElement).getPropertyValue(name);

  function cursor(context, width, height) {
    const x = scene.frames > 1 ? frame / (scene.frames - 1) * (width - 2) + 1 : 1;
    context.fillStyle = ink("--ink");
    context.fillRect(x - 0.75, 0, 1.5, height);
  }

  function drawSpans(view) {
    const { canvas, line } = view.spans, shown = layers.contacts && Boolean(view.robot.contacts);
    canvas.hidden = line.hidden = !shown;
    if (!shown) return;
    const context = canvas.getContext("2d"), width = canvas.width / SHARP, height = canvas.height / SHARP;
    const rows = rowsOf(view.robot), step = (width - 2) / Math.max(1, scene.frames - 1);
    context.setTransform(SHARP, 0, 0, SHARP, 0, 0);
    context.clearRect(0, 0, width, height);
    for (const [arm, thing, first, last] of view.robot.contacts) {
      context.fillStyle = ARMS[arm][1];
      context.fillRect(1 + first * step, 12 * rows.indexOf(`${arm} ${thing}`) + 2, Math.max(2, (last - first) * step), 8);
    }
    cursor(context, width, height);
  }

  function drawCurve(view) {
    const { canvas, value } = view.curve, context = canvas.getContext("2d");
    const width = canvas.width / SHARP, height = canvas.height / SHARP;
    const found = view.psnr.filter((number, t) => t && number !== null), low = Math.min(...found), high = Math.max(...found);
    const x = (t) => scene.frames > 1 ? t / (scene.frames - 1) * (width - 2) + 1 : 1;
    const y = (number) => height - 5 - (number - low) / Math.max(1, high - low) * (height - 10);
    context.setTransform(SHARP, 0, 0, SHARP, 0, 0);
    context.clearRect(0, 0, width, height);
    context.beginPath();
    let open = false;
    view.psnr.forEach((number, t) => {
      if (t && number !== null) context[open ? "lineTo" : "moveTo"](x(t), y(number));
      open = Boolean(t) && number !== null;
    });
    context.lineWidth = 1.5;
    context.strokeStyle = ink("--accent");
    context.stroke();
    cursor(context, width, height);
    const number = view.psnr[frame];
    const now = number === undefined ? "ended" : number === null ? "exact" : `${number.toFixed(1)} dB`;
    value.textContent = `${now} · ${summary(view.psnr)}`;
  }

  // --- The clock: a film's frame k is shown from k / rate on, and is sought half a frame later.

  function tell(number) {
    at("slider").value = number;
    const seconds = `${(number / scene.rate).toFixed(2)} s`;
    at("clock").textContent = `${number} / ${scene.frames - 1} · ${seconds}`;
    at("slider").setAttribute("aria-valuetext", `frame ${number}, ${seconds}`);
  }

  function show(number) {
    frame = Math.max(0, Math.min(scene.frames - 1, number));
    tell(frame);
    draw();
  }

  function seek(number) {
    if (!scene) return;
    wanted = Math.max(0, Math.min(scene.frames - 1, number));
    tell(wanted);
    if (!film.seeking) film.currentTime = (wanted + 0.5) / scene.rate;
  }

  film.addEventListener("seeked", () => {
    if (!scene) return;
    const reached = Math.floor(film.currentTime * scene.rate + 1e-3);
    if (!film.paused) return;
    if (reached === wanted) show(wanted);
    else seek(wanted);
  });

  function watch() {
    if (film.requestVideoFrameCallback) {
      film.requestVideoFrameCallback((now, shown) => {
        if (scene && !film.seeking && !film.paused) show(Math.round(shown.mediaTime * scene.rate));
        watch();
      });
    } else {
      requestAnimationFrame(() => {
        if (scene && !film.paused) show(Math.floor(film.currentTime * scene.rate + 1e-3));
        watch();
      });
    }
  }

  const now = () => (film.paused ? wanted : frame);

  function pause() {
    if (film.paused) return;
    film.pause();
    seek(frame); // what is drawn is the frame that is told
  }

  function step(count) {
    const from = now();
    pause();
    seek(from + count);
  }

  function toggle() {
    if (film.paused) film.play().catch((error) => complain(`The video cannot be played: ${error.message}`));
    else pause();
  }

  for (const name of ["play", "pause"]) {
    film.addEventListener(name, () => {
      at("play").textContent = film.paused ? "▶" : "❚❚";
      at("play").setAttribute("aria-label", film.paused ? "Play" : "Pause");
    });
  }
  film.addEventListener("loadeddata", () => { if (scene) seek(wanted); });
  film.addEventListener("error", () => {
    if (chosen) complain(`The video ${chosen.file} cannot be played. It must lie beside this page, and the browser must know H.264.`);
  });

  function complain(text) {
    at("alert").textContent = text;
    at("alert").hidden = !text;
  }

  // --- Scenes and models.

  window.explorerScene = (number, content) => {
    scripts.set(number, content);
    if (number === current) open(content);
  };

  function open(content) {
    scene = content;
    at("slider").max = scene.frames - 1;
    at("models").replaceChildren();
    scene.films.forEach((one, number) => { make(at("models"), "option", one.label).value = number; });
    at("models-label").hidden = !scene.films[0].label;
    wanted = 0;
    choose(0);
  }

  function choose(number) {
    film.pause();
    chosen = scene.films[number];
    build();
    film.src = chosen.file;
    film.playbackRate = film.defaultPlaybackRate = Number(at("speed").value);
    tell(wanted);
  }

  function go(number) {
    if (number === current || !index.scenes[number]) return;
    current = number;
    film.pause();
    scene = chosen = null;
    complain("");
    const entry = index.scenes[number];
    at("scenes").value = number;
    at("instruction").textContent = entry.instruction;
    at("notice").textContent = `${entry.left_out} more robots of this scene are not shown.`;
    at("notice").hidden = !entry.left_out;
    if (scripts.has(number)) open(scripts.get(number));
    else {
      const script = document.createElement("script");
      script.src = entry.script;
      script.onerror = () => complain(`${entry.script} is missing; copy the page's whole folder, or make the page again.`);
      document.head.append(script);
    }
  }

  const place = (entry) => `#${encodeURIComponent(entry.task)}/${entry.seed}`;

  function follow() {
    go(Math.max(0, index.scenes.findIndex((entry) => place(entry) === location.hash)));
  }

  // --- What is pressed.

  function turn(name) {
    const button = document.querySelector(`[data-layer="${name}"]`);
    if (button.disabled) return;
    layers[name] = !layers[name];
    button.setAttribute("aria-pressed", layers[name]);
    draw();
  }

  const visit = (number) => { if (index.scenes[number]) location.hash = place(index.scenes[number]); };
  const KEYS = {
    " ": toggle, ArrowLeft: (event) => step(event.shiftKey ? -10 : -1), ArrowRight: (event) => step(event.shiftKey ? 10 : 1),
    Home: () => step(-now()), End: () => step(scene.frames), m: () => turn("mask"), f: () => turn("flow"),
    k: () => turn("keypoints"), c: () => turn("contacts"), n: () => visit(current + 1), p: () => visit(current - 1),
  };
  document.addEventListener("keydown", (event) => {
    const tag = event.target.tagName, act = KEYS[event.key];
    const own = tag === "SELECT" || (tag === "BUTTON" && event.key === " "); // these keys are theirs
    if (!act || !scene || own || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    act(event);
  });

  for (const button of document.querySelectorAll("[data-layer]")) button.addEventListener("click", () => turn(button.dataset.layer));
  at("play").addEventListener("click", () => { if (scene) toggle(); });
  at("back").addEventListener("click", () => { if (scene) step(-1); });
  at("ahead").addEventListener("click", () => { if (scene) step(1); });
  at("slider").addEventListener("input", () => { if (scene) { film.pause(); seek(Number(at("slider").value)); } });
  at("speed").addEventListener("change", () => { film.playbackRate = film.defaultPlaybackRate = Number(at("speed").value); });
  at("models").addEventListener("change", () => choose(Number(at("models").value)));
  at("scenes").addEventListener("change", () => visit(Number(at("scenes").value)));
  window.addEventListener("hashchange", follow);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);

  const groups = new Map();
  index.scenes.forEach((entry, number) => {
    if (!groups.has(entry.task)) groups.set(entry.task, Object.assign(make(at("scenes"), "optgroup"), { label: entry.task }));
    make(groups.get(entry.task), "option", `${entry.task.replaceAll("_", " ")}, seed ${entry.seed}`).value = number;
  });
  watch();
  follow();
})();
