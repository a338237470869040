"""Style and script of a report's page."""

STYLE = """
:root {
  color-scheme: light dark;
  --page: #ffffff; --text: #1b1b1b; --soft: #5a5a5a; --line: #d8d8d8; --panel: #f5f6f7;
  --accent: #0072b2; --warn: #8a4b00; --warn-back: #fff4e0;
}
@media (prefers-color-scheme: dark) {
  :root {
    --page: #15181b; --text: #ececec; --soft: #a9aeb3; --line: #3a4046; --panel: #1e2327;
    --accent: #6cbcf0; --warn: #ffc069; --warn-back: #2f2718;
  }
}
* { box-sizing: border-box; }
body {
  margin: 0 auto; padding: 1rem clamp(0.75rem, 3vw, 2rem) 3rem; max-width: 76rem;
  background: var(--page); color: var(--text);
  font: 16px/1.5 system-ui, -apple-system, 'Segoe UI', Roboto, 'DejaVu Sans', sans-serif;
}
h1 { font-size: 1.6rem; line-height: 1.2; margin: 0.5rem 0 0.25rem; overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; margin: 2.2rem 0 0.4rem; border-bottom: 1px solid var(--line); }
h3 { font-size: 0.95rem; margin: 0.4rem 0 0; font-weight: 600; }
p { margin: 0.3rem 0 0.6rem; max-width: 65rem; }
a { color: var(--accent); }
.soft, figcaption { color: var(--soft); font-size: 0.9rem; }
nav { display: flex; flex-wrap: wrap; gap: 0.1rem 1rem; font-size: 0.9rem; }
.tiles {
  display: grid; gap: 0.6rem; margin: 1rem 0;
  grid-template-columns: repeat(auto-fit, minmax(10.5rem, 1fr));
}
.tiles div { background: var(--panel); border-radius: 0.5rem; padding: 0.55rem 0.8rem; }
.tiles b { display: block; font-size: 1.25rem; line-height: 1.3; overflow-wrap: anywhere; }
.tiles span { color: var(--soft); font-size: 0.85rem; }
.notes {
  background: var(--warn-back); color: var(--warn); border-radius: 0.5rem; margin: 0.8rem 0;
  padding: 0.6rem 0.8rem 0.6rem 1.8rem; overflow-wrap: anywhere;
}
figure { margin: 0.5rem 0; min-width: 0; }
.plot { width: 100%; }
.grid {
  display: grid; gap: 0.5rem 1rem;
  grid-template-columns: repeat(auto-fit, minmax(min(20rem, 100%), 1fr));
}
.key { display: flex; flex-wrap: wrap; gap: 0.1rem 1.2rem; list-style: none; margin: 0.4rem 0;
  padding: 0; font-size: 0.9rem; overflow-wrap: anywhere; }
.key i { display: inline-block; width: 1.6rem; height: 0.2rem; margin-right: 0.4rem;
  vertical-align: middle; background: var(--light); }
@media (prefers-color-scheme: dark) { .key i { background: var(--dark); } }
.scroll { overflow: auto; max-width: 100%; }
.long { max-height: 30rem; border-bottom: 1px solid var(--line); }
table { border-collapse: collapse; font-size: 0.9rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.25rem 0.7rem; border-bottom: 1px solid var(--line); text-align: left;
  white-space: nowrap; }
th { background: var(--panel); font-weight: 600; vertical-align: bottom; white-space: normal; }
td.number, th.number { text-align: right; }
button {
  font: inherit; font-size: 0.9rem; color: var(--accent); background: var(--panel);
  border: 1px solid var(--line); border-radius: 0.4rem; padding: 0.25rem 0.8rem;
  margin: 0.4rem 0; cursor: pointer;
}
button:focus-visible, a:focus-visible, .scroll:focus-visible {
  outline: 2px solid var(--accent); outline-offset: 2px;
}
details { margin: 0.6rem 0; }
summary { cursor: pointer; color: var(--accent); }
thead th { position: sticky; top: 0; }
@media print {
  button, nav, .modebar-container { display: none; }
  figure { break-inside: avoid; }
  .scroll, .long { overflow: visible; max-height: none; }
}
"""

SCRIPT = """
'use strict';
(() => {
  const given = JSON.parse(document.getElementById('report-data').textContent);
  const dark = window.matchMedia('(prefers-color-scheme: dark)');
  const coarse = window.matchMedia('(pointer: coarse)').matches;
  const FONT = getComputedStyle(document.body).fontFamily;
  const narrow = () => window.innerWidth < 600;

  // Colours in the figures are those of light mode.
  const coloured = figure => JSON.parse(JSON.stringify(figure).replace(
    /#[0-9A-F]{6}/g, colour => dark.matches ? given.dark[colour] || colour : colour));

  const themed = layout => {
    const style = getComputedStyle(document.documentElement);
    const colour = name => style.getPropertyValue('--' + name).trim();
    const axis = {
      gridcolor: colour('line'), zerolinecolor: colour('line'), linecolor: colour('soft'),
      showline: true, ticks: 'outside', tickcolor: colour('soft'), automargin: true,
    };
    const result = {
      ...layout, paper_bgcolor: 'rgba(0,0,0,0)', plot_bgcolor: 'rgba(0,0,0,0)',
      font: {color: colour('text'), size: narrow() ? 11 : 13, family: FONT},
      // Above the figure is room for the toolbar, below it for the legend.
      margin: {...(narrow() ? {l: 46, r: 8, b: 40} : {l: 62, r: 14, b: 46}), t: coarse ? 8 : 38},
      legend: {
        orientation: 'h', x: 0, yref: 'container', y: 0, yanchor: 'bottom',
        groupclick: 'togglegroup', bgcolor: 'rgba(0,0,0,0)',
      },
      modebar: {
        bgcolor: 'rgba(0,0,0,0)', color: colour('soft'), activecolor: colour('accent'),
      },
      hoverlabel: {bgcolor: colour('panel'), font: {color: colour('text')}, namelength: -1},
      // A finger on a figure scrolls the page.
      dragmode: coarse ? false : 'zoom', uirevision: 'kept',
    };
    for (const key of Object.keys(layout)) {
      if (!/^[xy]axis/.test(key)) continue;
      const title = {font: {size: narrow() ? 11 : 13}, ...layout[key].title};
      result[key] = {...axis, ...layout[key], title};
    }
    return result;
  };

  const config = {
    responsive: true, displaylogo: false, displayModeBar: coarse ? false : 'hover',
    modeBarButtonsToRemove: ['select2d', 'lasso2d', 'autoScale2d'],
    toImageButtonOptions: {format: 'svg'},
  };
  // A legend of many names makes its figure taller, not the plot lower.
  const grow = (element, figure) => {
    const legend = element.querySelector('.legend .bg');
    const rows = legend ? legend.getBoundingClientRect().height : 0;
    const height = Math.round(figure.height + Math.max(rows - 30, 0));
    if (Math.abs(parseFloat(element.style.height) - height) < 2) return undefined;
    element.style.height = `${height}px`;
    return Plotly.Plots.resize(element);
  };
  const draw = async (element, figure) => {
    const now = coloured(figure);
    await Plotly.react(element, now.data, themed(now.layout), config);
    await grow(element, figure);
    // The first time it may have been cut for want of room.
    await grow(element, figure);
  };
  const figures = given.figures.map(figure => [document.getElementById(figure.key), figure]);
  const drawn = new Set();
  const show = ([element, figure]) => {
    if (drawn.has(element)) return;
    drawn.add(element);
    draw(element, figure);
  };
  // What is far below is drawn when it comes near.
  const watcher = new IntersectionObserver(entries => {
    for (const entry of entries) {
      if (entry.isIntersecting) show(figures.find(([element]) => element === entry.target));
    }
  }, {rootMargin: '800px'});
  figures.forEach(([element]) => watcher.observe(element));
  window.addEventListener('beforeprint', () => figures.forEach(show));
  dark.addEventListener('change', () => figures.forEach(([element, figure]) => {
    if (drawn.has(element)) draw(element, figure);
  }));

  const copy = async text => {
    try {
      await navigator.clipboard.writeText(text);
    } catch {
      const area = document.createElement('textarea');
      area.value = text;
      document.body.append(area);
      area.select();
      document.execCommand('copy');
      area.remove();
    }
  };
  for (const button of document.querySelectorAll('button[data-table]')) {
    button.addEventListener('click', async () => {
      const rows = document.getElementById(button.dataset.table).rows;
      const value = cell => cell.dataset.value ?? cell.textContent.trim();
      await copy(Array.from(
        rows, row => Array.from(row.cells, value).join('\\t')).join('\\n'));
      const label = button.textContent;
      button.textContent = 'Copied';
      setTimeout(() => { button.textContent = label; }, 1500);
    });
  }
})();
"""
