'use strict';
// Draws a figure from its description (hmsa/report/figures.py) as SVG: panels above each other
// with a common x axis, a legend that hides curves, zoom, pan, and values under the pointer.
const drawFigure = (() => {
  // Axes are linear in these coordinates.
  const SCALES = {
    linear: {to: x => x, from: u => u},
    log: {to: Math.log10, from: u => 10 ** u},
    symlog: {
      to: x => Math.abs(x) <= 1 ? x : Math.sign(x) * (1 + Math.log10(Math.abs(x))),
      from: u => Math.abs(u) <= 1 ? u : Math.sign(u) * 10 ** (Math.abs(u) - 1),
    },
  };
  const PT = 4 / 3, GAP = 18, FAR = 1e5, NEAR = 40, SMALL = 6, ZOOM = 1.5;
  const MARKERS = {
    o: r => `m${-r},0a${r},${r} 0 1,0 ${2 * r},0a${r},${r} 0 1,0 ${-2 * r},0`,
    s: r => `m${-r},${-r}h${2 * r}v${2 * r}h${-2 * r}z`,
    x: r => `m${-r},${-r}l${2 * r},${2 * r}m0,${-2 * r}l${-2 * r},${2 * r}`,
  };
  const HELP = 'Drag to zoom, drag with Shift to move, double-click to go back.';

  const make = (parent, name, attributes = {}, text = '') => {
    const element = parent.ownerDocument.createElementNS(parent.namespaceURI, name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    if (text) element.textContent = text;
    parent.append(element);
    return element;
  };
  // The page replaces colours in dark mode.
  const colour = hex => `var(--${hex.slice(1)}, ${hex})`;
  const clamp = x => Math.max(-FAR, Math.min(FAR, x)).toFixed(1);

  // Numbers -----------------------------------------------------------------------------------

  const raised = number => String(number).replace(
    /./g, x => '⁻⁰¹²³⁴⁵⁶⁷⁸⁹'['-0123456789'.indexOf(x)]);
  const minus = text => text.replace('-', '−');
  // A number to the digits that tell it from another one at a distance of `step`.
  const text = (value, step) => {
    const size = Math.abs(value), places = Math.floor(Math.log10(step) + 1e-9);
    if (size < step * 1e-6) return '0';
    if (size < 1e5 && places >= -5) return minus(value.toFixed(Math.max(0, -places)));
    const power = Math.floor(Math.log10(size) + 1e-9);
    const digits = (value / 10 ** power).toFixed(Math.max(0, power - places));
    return minus(digits === '1' ? '' : `${digits}·`) + `10${raised(power)}`;
  };
  // A number to six digits, without zeros at the end.
  const value = x => text(x, 10 ** (Math.floor(Math.log10(Math.abs(x) || 1)) - 5))
    .replace(/(\.\d*?)0+(?=·|$)/, '$1').replace(/\.(?=·|$)/, '');

  // Ticks in round numbers: [place, text].
  const even = (low, high, count) => {
    const power = 10 ** Math.floor(Math.log10((high - low) / count));
    const step = power * [1, 2, 5, 10].find(x => x * power * count >= (high - low) * (1 - 1e-9));
    const found = [];
    for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * step; i++) {
      found.push([i * step, text(i * step, step)]);
    }
    return found;
  };
  const ticksOf = (axis, [low, high], count) => {
    const {from} = SCALES[axis.scale];
    if (axis.ticks.length) return axis.ticks.filter(([x]) => x >= low && x <= high);
    if (axis.scale !== 'linear') {
      // Whole numbers are decades.
      const step = Math.ceil((high - low) / count), found = [];
      for (let u = Math.ceil(low / step) * step; u <= high; u += step) {
        const x = from(u);
        found.push([x, text(x, 10 ** Math.floor(Math.log10(Math.abs(x) || 1)))]);
      }
      if (found.length > 2) return found;
    }
    return even(from(low), from(high), count);
  };

  // Curves ------------------------------------------------------------------------------------

  const increasing = x => x.every((y, i) => !i || y === null || x[i - 1] === null || y >= x[i - 1]);
  const pathOf = (curve, x, y, box) => {
    if (curve.form === 'vertical') {
      return curve.x.map(v => `M${clamp(x(v))},${box.top}V${box.bottom}`).join('');
    }
    if (curve.form === 'horizontal') {
      return curve.y.map(v => `M${box.left},${clamp(y(v))}H${box.right}`).join('');
    }
    const known = curve.x.map((v, i) => v !== null && curve.y[i] !== null);
    const at = i => `${clamp(x(curve.x[i]))},${clamp(y(curve.y[i]))}`;
    const every = one => curve.x.map((_, i) => known[i] ? one(i) : '').join('');
    if (curve.form === 'points') {
      const shape = MARKERS[curve.marker](curve.size * 0.8);
      return every(i => `M${at(i)}${shape}`);
    }
    if (curve.form === 'bars') {
      const half = 0.45 * Math.min(...curve.x.slice(1).map((v, i) => v - curve.x[i]));
      return every(i => `M${clamp(x(curve.x[i] - half))},${clamp(y(0))}V${clamp(y(curve.y[i]))}`
        + `H${clamp(x(curve.x[i] + half))}V${clamp(y(0))}z`);
    }
    if (curve.form === 'band') {
      const back = curve.x.map((v, i) => `${clamp(x(v))},${clamp(y(curve.lower[i]))}`).reverse();
      return `M${curve.x.map((_, i) => at(i)).join('L')}L${back.join('L')}z`;
    }
    return every(i => !i || !known[i - 1] ? `M${at(i)}`
      : curve.form === 'steps' ? `H${clamp(x(curve.x[i]))}V${clamp(y(curve.y[i]))}` : `L${at(i)}`);
  };
  const styleOf = curve => {
    const own = colour(curve.colour);
    if (curve.form === 'band') return {fill: own, 'fill-opacity': curve.opacity, stroke: 'none'};
    if (curve.form === 'bars') return {fill: own, stroke: 'none'};
    const marker = curve.form === 'points';
    return {
      fill: marker && curve.filled && curve.marker !== 'x' ? own : 'none', stroke: own,
      'stroke-width': marker ? 1.3 : curve.width * PT, 'stroke-opacity': curve.opacity,
      'stroke-linejoin': 'round',
      'stroke-dasharray': marker ? ''
        : curve.dash.map(x => x * Math.max(curve.width, 1) * PT).join(' '),
    };
  };
  const paint = (element, attributes) => {
    for (const [key, x] of Object.entries(attributes)) {
      // A variable works in a style only.
      if (x !== '') element.style.setProperty(key, x);
    }
    return element;
  };
  // The point of a curve that is next to a place on the screen, and its distance.
  const nearest = (curve, px, py, x, y) => {
    let best = -1, least = Infinity;
    for (let i = 0; i < curve.x.length; i++) {
      if (curve.x[i] === null || curve.y[i] === null) continue;
      const dx = x(curve.x[i]) - px;
      if (curve.form === 'steps' ? dx > 0 : Math.abs(dx) > least) continue;
      const distance = curve.form === 'steps' ? 0
        : curve.sorted ? Math.abs(dx) : Math.hypot(dx, y(curve.y[i]) - py);
      if (distance <= least) [best, least] = [i, distance];
    }
    return [best, least];
  };

  return (element, figure) => {
    const svg = element.querySelector('svg'), {panels} = figure;
    const all = panels.flatMap(x => x.curves);
    const box = svg.parentElement, tip = make(box, 'div', {class: 'tip', hidden: ''});
    // Names of hidden curves.
    const off = new Set(all.filter(x => x.hidden).map(x => x.name));
    for (const curve of all) curve.sorted = increasing(curve.x);
    const limits = axis => axis.limits.map(SCALES[axis.scale].to);
    const whole = () => ({x: limits(panels[0].x), y: panels.map(panel => limits(panel.y))});
    let view = whole(), places = [], moving = false, waiting = false;

    const draw = () => {
      waiting = false;
      const width = box.clientWidth, height = box.clientHeight, narrow = width < 520;
      if (!width) return;
      svg.replaceChildren();
      svg.setAttribute('viewBox', `0 0 ${width} ${height}`);
      const size = narrow ? 11 : 12.5, letter = 0.58 * size;
      const below = 2.9 * size, sum = panels.reduce((x, panel) => x + panel.height, 0);
      const room = height - below - 6 - GAP * (panels.length - 1);
      let top = 6;
      const rows = panels.map((panel, i) => {
        const bottom = top + room * panel.height / sum, row = {top, bottom};
        row.ticks = panel.curves.length
          ? ticksOf(panel.y, view.y[i], Math.max(2, (bottom - top) / (2.6 * size))) : [];
        top = bottom + GAP;
        return row;
      });
      const longest = Math.max(1, ...rows.flatMap(x => x.ticks.map(([, word]) => word.length)));
      const left = 1.7 * size + letter * longest + 8, right = width - 18;
      const across = ticksOf(panels[0].x, view.x, Math.max(2, (right - left) / (narrow ? 62 : 90)));
      const clip = `clip-${figure.key}`;
      places = panels.map((panel, i) => {
        const {top, bottom, ticks} = rows[i], [x0, x1] = view.x, [y0, y1] = view.y[i];
        const toX = SCALES[panel.x.scale].to, toY = SCALES[panel.y.scale].to;
        const x = v => left + (toX(v) - x0) / (x1 - x0) * (right - left);
        const y = v => bottom - (toY(v) - y0) / (y1 - y0) * (bottom - top);
        const area = {left, right, top, bottom};
        make(make(svg, 'clipPath', {id: `${clip}-${i}`}), 'rect', {
          x: left, y: top, width: right - left, height: bottom - top});
        make(svg, 'path', {class: 'grid-lines', d: ticks.map(
          ([v]) => `M${left},${clamp(y(v))}H${right}`).join('') + across.map(
          ([v]) => `M${clamp(x(v))},${top}V${bottom}`).join('')});
        for (const [v, word] of ticks) {
          make(svg, 'text', {x: left - 6, y: y(v) + 0.35 * size, 'text-anchor': 'end'}, word);
        }
        if (i === panels.length - 1) {
          for (const [v, word] of across) {
            make(svg, 'text', {x: x(v), y: bottom + 1.35 * size, 'text-anchor': 'middle'}, word);
          }
        }
        make(svg, 'text', {
          class: 'label', transform: `translate(${0.95 * size},${(top + bottom) / 2}) rotate(-90)`,
          'text-anchor': 'middle',
          // A long label of a low panel is smaller.
          style: `font-size: ${Math.min(size, (bottom - top + GAP) * size
            / (letter * panel.y.label.length))}px`,
        }, panel.y.label);
        const curves = make(svg, 'g', {'clip-path': `url(#${clip}-${i})`});
        for (const curve of [...panel.curves].sort((a, b) => a.order - b.order)) {
          if (off.has(curve.name)) continue;
          const d = pathOf(curve, x, y, area);
          const drawn = d && make(curves, 'path', {class: 'curve', d, 'data-name': curve.name});
          if (drawn) paint(drawn, styleOf(curve));
        }
        make(svg, 'path', {class: 'frame', d: `M${left},${top}V${bottom}H${right}`});
        return {...area, x, y, guide: make(svg, 'path', {class: 'guide'})};
      });
      make(svg, 'text', {class: 'label', x: (left + right) / 2, y: height - 0.35 * size,
        'text-anchor': 'middle'}, panels[0].x.label);
      svg.style.fontSize = `${size}px`;
    };
    const redraw = () => {
      tip.hidden = true;
      if (!waiting) { waiting = true; requestAnimationFrame(draw); }
    };

    // Zoom and pan, by fractions of the axes ---------------------------------------------------

    const cut = ([low, high], from, to) => [low + from * (high - low), low + to * (high - low)];
    const zoom = (factor, fx = 0.5, fy = 0.5, only = -1) => {
      view.x = cut(view.x, fx - fx / factor, fx + (1 - fx) / factor);
      view.y = view.y.map((y, i) => only >= 0 && i !== only ? y
        : cut(y, fy - fy / factor, fy + (1 - fy) / factor));
      redraw();
    };
    const pan = (dx, dy, only = -1) => {
      view.x = cut(view.x, dx, 1 + dx);
      view.y = view.y.map((y, i) => only >= 0 && i !== only ? y : cut(y, dy, 1 + dy));
      redraw();
    };
    const reset = () => { view = whole(); redraw(); };
    const where = event => {
      const outer = svg.getBoundingClientRect();
      const px = event.clientX - outer.left, py = event.clientY - outer.top;
      const distance = ({top, bottom}) => Math.max(top - py, py - bottom, 0);
      const i = places.reduce((best, x, k) => distance(x) < distance(places[best]) ? k : best, 0);
      const {left, right, top, bottom} = places[i];
      return {px, py, i, fx: (px - left) / (right - left), fy: (bottom - py) / (bottom - top)};
    };

    // Values under the pointer -----------------------------------------------------------------

    const read = event => {
      if (!places.length) return;
      const {px, py, i: own} = where(event);
      let lines = [];
      panels.forEach((panel, i) => {
        const {x, y, left, right, top, bottom} = places[i], names = new Set();
        for (const curve of panel.curves) {
          const passive = ['vertical', 'horizontal', 'band'].includes(curve.form);
          if (passive || off.has(curve.name) || names.has(curve.name)) continue;
          if (!curve.sorted && i !== own) continue;
          const [at, distance] = nearest(curve, px, py, x, y);
          if (at < 0 || distance > NEAR) continue;
          names.add(curve.name);
          lines.push({curve, distance, x: curve.x[at], y: curve.y[at]});
        }
        places[i].guide.setAttribute(
          'd', px >= left && px <= right ? `M${px},${top}V${bottom}` : '');
      });
      const closest = (a, b) => b.distance < a.distance ? b : a;
      // Of curves that turn back, the nearest.
      if (lines.some(line => !line.curve.sorted)) lines = [lines.reduce(closest)];
      tip.hidden = !lines.length;
      if (!lines.length) return;
      tip.replaceChildren();
      // A level has begun before.
      const points = lines.filter(line => line.curve.form !== 'steps');
      const {x: at} = (points.length ? points : lines).reduce(closest);
      const {label, ticks} = panels[0].x;
      make(tip, 'div', {}, `${label}: ${(ticks.find(([x]) => x === at) ?? [at, value(at)])[1]}`);
      for (const {curve, y} of lines) {
        const row = make(tip, 'div');
        make(row, 'i').style.background = colour(curve.colour);
        make(row, 'span', {}, `${curve.name}: ${value(y)}`);
      }
      const width = box.clientWidth;
      tip.style.left = `${px > width / 2 ? px - tip.offsetWidth - 14 : px + 14}px`;
      tip.style.top = `${Math.max(0, Math.min(py, box.clientHeight - tip.offsetHeight))}px`;
    };
    const leave = () => {
      tip.hidden = true;
      for (const {guide} of places) guide.setAttribute('d', '');
    };

    // Pointers: a mouse draws a frame or moves the view; two fingers do both --------------------

    const fingers = new Map();
    // The middle between two fingers, and their distance.
    const pair = () => {
      const [a, b] = fingers.values();
      return {
        ...where({clientX: (a.clientX + b.clientX) / 2, clientY: (a.clientY + b.clientY) / 2}),
        apart: Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY),
      };
    };
    let start = null, frame = null;
    svg.addEventListener('pointerdown', event => {
      if (event.button || !places.length) return;
      if (event.pointerType === 'mouse') {
        event.preventDefault();
        element.focus({preventScroll: true});
        svg.setPointerCapture(event.pointerId);
        start = {...where(event), pan: moving || event.shiftKey};
      } else {
        fingers.set(event.pointerId, event);
        read(event);
      }
    });
    svg.addEventListener('pointermove', event => {
      if (fingers.size === 2 && fingers.has(event.pointerId)) {
        const before = pair();
        fingers.set(event.pointerId, event);
        const now = pair();
        pan(before.fx - now.fx, before.i === now.i ? before.fy - now.fy : 0, now.i);
        if (before.apart && now.apart) zoom(now.apart / before.apart, now.fx, now.fy, now.i);
        return;
      }
      if (!start) { read(event); return; }
      const now = where(event), {left, right, top, bottom} = places[start.i];
      if (start.pan) {
        pan(start.fx - now.fx, (start.py - now.py) / (top - bottom), start.i);
        start = {...start, ...now, i: start.i};
        return;
      }
      const within = (x, low, high) => Math.max(low, Math.min(high, x));
      const x = [start.px, now.px].map(v => within(v, left, right)).sort((a, b) => a - b);
      let y = [start.py, now.py].map(v => within(v, top, bottom)).sort((a, b) => a - b);
      // A flat frame is a range of x.
      if (y[1] - y[0] < 3 * SMALL) y = [top, bottom];
      frame?.remove();
      frame = make(svg, 'rect', {
        class: 'zoom-frame', x: x[0], y: y[0], width: x[1] - x[0], height: y[1] - y[0]});
      start.chosen = {
        x: x.map(v => (v - left) / (right - left)), y: y.map(v => (bottom - v) / (bottom - top))};
      start.wide = x[1] - x[0] >= SMALL;
    });
    const end = event => {
      fingers.delete(event.pointerId);
      if (start?.wide && event.type === 'pointerup') {
        const {x, y} = start.chosen;
        view.x = cut(view.x, ...x);
        view.y[start.i] = cut(view.y[start.i], y[1], y[0]);
        redraw();
      }
      frame?.remove();
      start = frame = null;
    };
    for (const kind of ['pointerup', 'pointercancel']) svg.addEventListener(kind, end);
    svg.addEventListener('pointerleave', event => { if (event.pointerType === 'mouse') leave(); });
    svg.addEventListener('dblclick', reset);
    svg.addEventListener('wheel', event => {
      // Without a key, the wheel scrolls the page.
      if (!event.ctrlKey && !event.metaKey) return;
      event.preventDefault();
      const {fx, fy, i} = where(event);
      zoom(Math.exp(-event.deltaY / 300), fx, fy, i);
    }, {passive: false});
    const keys = {
      '+': () => zoom(ZOOM), '-': () => zoom(1 / ZOOM), 0: reset, Escape: reset,
      ArrowLeft: () => pan(-0.1, 0), ArrowRight: () => pan(0.1, 0),
      ArrowUp: () => pan(0, 0.1), ArrowDown: () => pan(0, -0.1),
    };
    element.addEventListener('keydown', event => {
      if (event.target !== element || event.ctrlKey || event.metaKey || !keys[event.key]) return;
      event.preventDefault();
      keys[event.key]();
    });

    // Buttons and legend -----------------------------------------------------------------------

    const bar = make(element, 'div', {class: 'bar'});
    const legend = make(bar, 'div', {class: 'legend'}), tools = make(bar, 'div');
    const button = (sign, title, act) => {
      const one = make(tools, 'button', {type: 'button', title, 'aria-label': title}, sign);
      one.addEventListener('click', act);
      return one;
    };
    if (figure.legend) {
      const seen = new Set();
      for (const curve of all) {
        if (!curve.listed || seen.has(curve.name)) continue;
        seen.add(curve.name);
        const entry = make(legend, 'button', {
          type: 'button', class: 'entry', 'aria-pressed': !off.has(curve.name),
          title: 'Show or hide'});
        const picture = svg.cloneNode();
        for (const name of [...picture.getAttributeNames()]) picture.removeAttribute(name);
        picture.setAttribute('class', 'swatch');
        picture.setAttribute('viewBox', '0 0 30 12');
        entry.append(picture);
        const form = {points: 'points', bars: 'band', band: 'band'}[curve.form] ?? 'line';
        const high = form === 'band' ? 2 : 6;
        const sample = {
          ...curve, form, x: form === 'points' ? [15] : [1, 29], y: [high, high], lower: [10, 10]};
        paint(make(picture, 'path', {d: pathOf(sample, x => x, y => y)}), styleOf(sample));
        make(entry, 'span', {}, curve.name);
        entry.addEventListener('click', () => {
          if (!off.delete(curve.name)) off.add(curve.name);
          entry.setAttribute('aria-pressed', !off.has(curve.name));
          redraw();
        });
      }
    }
    button('+', 'Zoom in', () => zoom(ZOOM));
    button('−', 'Zoom out', () => zoom(1 / ZOOM));
    const mover = button('✥', 'Drag to move instead of to zoom', () => {
      moving = !moving;
      mover.setAttribute('aria-pressed', moving);
    });
    mover.setAttribute('aria-pressed', false);
    button('⟲', 'Back to the beginning', reset);
    element.tabIndex = 0;
    svg.setAttribute('aria-description', HELP);
    new ResizeObserver(redraw).observe(box);
    draw();
  };
})();
