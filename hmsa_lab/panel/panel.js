// Shows the frames of hmsa panel and sends its commands; stores nothing, requests nothing else.
'use strict';

const $ = id => document.getElementById(id);
const SILENT_MS = 1500, RETRY_MS = 1000, SILENT_S = 3.5, GUTTER = 58;
let socket = null, frame = null, heard = 0, note = 0;
const charts = {};

function connect() {
  socket = new WebSocket(`ws://${location.host}${location.pathname}socket`);
  socket.onmessage = event => { heard = performance.now(); take(JSON.parse(event.data)); };
  socket.onclose = () => setTimeout(connect, RETRY_MS);
}

function send(command) {
  if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(command));
}

function put(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

function number(value, digits) {
  return value === null || value === undefined ? '–' : value.toFixed(digits).replace('-', '\u2212');
}

// Gives the parent one child for each item, filled with its item. Received text is never HTML.
function list(parent, items, make, fill) {
  while (parent.children.length > items.length) parent.lastElementChild.remove();
  while (parent.children.length < items.length) parent.append(make());
  items.forEach((item, i) => fill(parent.children[i], item));
}

function make(name, className) {
  const element = document.createElement(name);
  if (className) element.className = className;
  return element;
}

// Received frames -----------------------------------------------------------------------------

function take(next) {
  frame = next;
  for (const [name, chart] of Object.entries(frame.charts)) {
    const kept = charts[name] ??= {newest: -Infinity};
    for (const kind of ['stretch', 'target', 'flux']) {
      const sides = kept[kind] ??= [[], []];
      const ends = chart[kind], first = frame.slot - ends[0].length + 1;
      for (let side = 0; side < 2; side++) {
        // Slots without data are empty.
        const from = Math.max(kept.newest + 1, frame.slot - frame.slots + 1);
        for (let slot = from; slot < first; slot++) sides[side][slot % frame.slots] = null;
        ends[side].forEach((x, i) => { sides[side][(first + i) % frame.slots] = x; });
      }
    }
    kept.newest = frame.slot;
  }
}

// Display -------------------------------------------------------------------------------------

function show() {
  requestAnimationFrame(show);
  const live = performance.now() - heard < SILENT_MS;
  document.documentElement.dataset.live = live;
  for (const button of document.querySelectorAll('main button')) button.disabled = !live;
  if (!live) {
    put($('where'), 'not connected');
    $('note').className = 'ERROR';
    put($('note'), 'The panel does not answer: it may have ended. '
      + 'hmsa stop in a terminal stops the actuator.');
    note = -1;
    return;
  }
  if (frame === null) return;
  const rate = frame.sample_rate === null ? '' : ` \u00b7 ${frame.sample_rate.toFixed(0)} samples/s`;
  put($('where'), frame.where.replace(/ +/g, ' ') + rate);
  if (frame.note.number !== note) {
    note = frame.note.number;
    $('note').className = frame.note.level;
    put($('note'), frame.note.text);
  }
  put($('stop'), frame.stopping ? 'Stopping' : 'Stop');
  interlock();
  $('waiting').hidden = !frame.waiting.length;
  list($('waiting'), frame.waiting, () => make('li'), put);
  status();
  list($('joints'), frame.joints, () => $('joint').content.cloneNode(true).firstElementChild, joint);
  controls();
}

function interlock() {
  const {present, closed} = frame.interlock, open = closed === false;
  $('coil').hidden = !present;
  $('close').hidden = !(present && (open || frame.request?.code === 'interlock'));
  put($('emergency'), present
    ? 'In an emergency, Coil off opens the interlock of the driver; a switch in the supply of the amplifier is safer.'
    : 'The emergency stop is the interlock of a driver (~/interlock); no driver listens now.');
}

function status() {
  const request = frame.request;
  $('level').className = `level ${request ? request.level : ''}`;
  $('level').hidden = !request;
  put($('level'), request ? request.level : '');
  put($('message'), request ? request.message
    : frame.waiting.length ? '' : 'No request yet: choose a target and press Go, or send a sequence.');
  const finding = request && !request.message.includes(request.finding) ? request.finding : '';
  $('finding').hidden = !finding;
  put($('finding'), finding);
  $('progress').value = frame.progress ?? 0;
  put($('state'), request ? request.state.replace('_', ' ')
    + (request.setpoints ? `, ${request.setpoint} of ${request.setpoints}` : '') : '');
}

function joint(card, seen) {
  const chart = frame.charts[seen.name], name = chart.coordinate;
  put(card.querySelector('h2'), seen.name);
  const texts = {
    name, label: name, stretch: number(seen.stretch, 5), target: number(seen.target, 5),
    error: seen.stretch === null || seen.target === null ? '–'
      : (seen.stretch - seen.target).toExponential(1).replaceAll('-', '\u2212'),
    flux: seen.flux_density === null ? '–'
      : `${number(1e3 * seen.flux_density, 2)} mT`};
  for (const place of card.querySelectorAll('[data-of]')) put(place, texts[place.dataset.of]);
  const kept = charts[seen.name];
  draw(card.querySelector('[data-chart=stretch]'), [['--target', kept.target, [6, 4]],
    ['--accent', kept.stretch, []]], 1, 2e-3, `${name} of ${seen.name}`);
  draw(card.querySelector('[data-chart=flux]'), [['--flux', kept.flux, []]], 1e3, 1,
    `flux density of ${seen.name}`);
}

// The distance of ticks: 1, 2 or 5 times a power of ten.
function distance(range, count) {
  const power = 10 ** Math.floor(Math.log10(range / count));
  return power * [1, 2, 5, 10].find(x => x * power * count >= range);
}

function draw(canvas, lines, scale, least, label) {
  canvas.setAttribute('aria-label', label);
  const ratio = devicePixelRatio, width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const style = getComputedStyle(canvas), colour = name => style.getPropertyValue(name);
  const pen = canvas.getContext('2d');
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  let low = Infinity, high = -Infinity;
  for (const [, [lows, highs]] of lines) {
    for (const x of lows) if (x !== null && x !== undefined) low = Math.min(low, scale * x);
    for (const x of highs) if (x !== null && x !== undefined) high = Math.max(high, scale * x);
  }
  if (low > high) [low, high] = [0, 1];
  const room = Math.max(0.08 * (high - low), 0.5 * (least - (high - low)));
  [low, high] = [low - room, high + room];
  const below = 18, place = y => 8 + (high - y) / (high - low) * (height - below - 12);
  pen.font = `11px ${style.fontFamily}`;
  pen.fillStyle = colour('--soft');
  pen.strokeStyle = colour('--grid');
  pen.lineWidth = 1;
  pen.textAlign = 'right';
  pen.textBaseline = 'middle';
  const step = distance(high - low, Math.max(2, height / 35));
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  for (let i = Math.ceil(low / step); i * step <= high; i++) {
    const y = Math.round(place(i * step)) + 0.5;
    pen.beginPath();
    pen.moveTo(GUTTER, y);
    pen.lineTo(width, y);
    pen.stroke();
    pen.fillText(number(i * step, digits), GUTTER - 6, y);
  }
  pen.textBaseline = 'bottom';
  for (let i = 0; i <= 4; i++) {
    pen.textAlign = i === 0 ? 'left' : i === 4 ? 'right' : 'center';
    pen.fillText(i === 4 ? 'now' : `${number(-frame.span * (1 - i / 4), 3).replace(/\.?0+$/, '')} s`,
      GUTTER + i / 4 * (width - GUTTER), height);
  }
  const count = frame.slots, across = (width - GUTTER) / (count - 1);
  pen.lineWidth = 1.6;
  pen.lineJoin = 'round';
  for (const [name, [lows, highs], dash] of lines) {
    pen.strokeStyle = colour(name);
    pen.setLineDash(dash);
    pen.beginPath();
    let before = -Infinity;
    for (let i = 0; i < count; i++) {
      const slot = (frame.slot - count + 1 + i) % count;
      if (lows[slot] === null || lows[slot] === undefined) continue;
      const x = GUTTER + i * across;
      // A gap in the data is a gap in the curve.
      if (i - before < count / 40) pen.lineTo(x, place(scale * lows[slot]));
      else pen.moveTo(x, place(scale * lows[slot]));
      if (highs[slot] !== lows[slot]) pen.lineTo(x, place(scale * highs[slot]));
      before = i;
    }
    pen.stroke();
  }
  pen.setLineDash([]);
}

function controls() {
  list($('modes'), frame.modes, () => make('button'), (button, mode) => {
    put(button, mode);
    button.type = 'button';
    button.dataset.mode = mode;
    button.disabled = !frame.feedback || frame.setting;
    button.setAttribute('aria-pressed', frame.feedback === mode);
  });
  list($('estimates'), frame.estimates, () => make('div'), estimate);
  const recording = frame.recording, on = recording.state === 'on';
  $('record').setAttribute('aria-pressed', on);
  $('record').disabled = !on && recording.state !== 'off';
  put($('record'), on ? 'Stop recording' : 'Record');
  put($('recording'), on ? `${recording.seconds.toFixed(0)} s to ${recording.bag}` : {
    off: recording.bag, closing: 'closing the bag', reporting: 'making the report'}[recording.state]);
  list($('reports'), recording.reports, () => {
    const item = make('li'), link = make('a');
    link.target = '_blank';
    link.rel = 'noopener noreferrer';
    item.append(link);
    return item;
  }, (item, name) => {
    put(item.firstElementChild, `report of ${name}`);
    item.firstElementChild.href = `report/${encodeURIComponent(name)}`;
  });
  // A recorder that the panel has ended is not reported as silent.
  const missed = x => x.age < SILENT_S || x.name !== 'recorder';
  list($('nodes'), frame.reports.filter(missed), () => {
    const item = make('li');
    item.append(make('b'), ' ', make('span'));
    return item;
  }, (item, report) => {
    const silent = report.age > SILENT_S;
    item.firstElementChild.className = `level ${silent ? 'STALE' : report.level}`;
    put(item.firstElementChild, silent ? 'STALE' : report.level);
    put(item.lastElementChild, `${report.name}: `
      + (silent ? `silent for ${report.age.toFixed(0)} s` : report.message));
  });
}

// The message, the parameters that differ from the given ones, and the others folded away.
function estimate(place, seen) {
  if (!place.children.length) {
    place.innerHTML = '<p class="soft"></p><div></div><details><summary></summary><div></div></details>';
  }
  const [sentence, found, rest] = place.children;
  put(sentence, (frame.estimates.length > 1 ? `${seen.joint}: ` : '') + seen.message);
  const same = seen.rows.filter(x => x[1] === x[3]);
  list(found, seen.rows.filter(x => x[1] !== x[3]), bar, fill);
  rest.hidden = !same.length;
  put(rest.firstElementChild, `${same.length} with the given values`);
  list(rest.lastElementChild, same, bar, fill);
}

function bar() {
  const item = make('div', 'bar');
  item.innerHTML = '<span></span><span></span><svg aria-hidden="true"><line class="axis"/>'
    + '<line class="given"/><line class="range"/><circle r="4"/></svg>';
  return item;
}

// A value with two standard deviations on both sides, and the given one, on a common axis.
function fill(item, [name, value, deviation, given]) {
  put(item.children[0], name.replaceAll('_', ' '));
  const digits = deviation > 0 ? Math.min(Math.max(1 - Math.floor(Math.log10(deviation)), 0), 7) : 4;
  put(item.children[1],
    `${number(value, digits)} \u00b1 ${number(deviation, digits)} (given ${number(given, digits)})`);
  const [axis, mark, range, dot] = item.querySelector('svg').children;
  const width = item.clientWidth, wide = 2 * (deviation ?? 0);
  if (value === null || given === null || !width) return;
  const reach = Math.max(Math.abs(value - given) + wide, 0.3 * Math.abs(given), 1e-12);
  const at = x => width / 2 + Math.max(-1, Math.min(1, (x - given) / reach)) * (width / 2 - 6);
  const line = (element, x1, y1, x2, y2) => Object.entries({x1, y1, x2, y2}).forEach(
    ([key, x]) => element.setAttribute(key, x));
  line(axis, 6, 8, width - 6, 8);
  line(mark, at(given), 1, at(given), 15);
  line(range, at(value - wide), 8, at(value + wide), 8);
  dot.setAttribute('cx', at(value));
  dot.setAttribute('cy', 8);
}

// Controls ------------------------------------------------------------------------------------

$('stop').onclick = () => send({do: 'stop'});
$('coil').onclick = () => send({do: 'coil_off'});
$('close').onclick = () => send({do: 'close_interlock'});
addEventListener('keydown', event => { if (event.key === 'Escape') send({do: 'stop'}); });
$('move').onsubmit = event => {
  event.preventDefault();
  send({do: 'send', setpoints: `${$('stretch').value.trim()}:${$('seconds').value.trim()}`});
};
$('sequence').onsubmit = event => {
  event.preventDefault();
  send({do: 'send', setpoints: $('setpoints').value});
};
$('examples').onclick = event => {
  if (event.target.dataset.sequence) $('setpoints').value = event.target.dataset.sequence;
};
$('modes').onclick = event => {
  if (event.target.dataset.mode) send({do: 'feedback', mode: event.target.dataset.mode});
};
$('record').onclick = () => send({do: 'record', on: frame.recording.state !== 'on'});

connect();
heard = performance.now();
show();
