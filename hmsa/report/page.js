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
      // Leave room for the toolbar above the figure, and for the legend below.
      margin: {...(narrow() ? {l: 46, r: 8, b: 40} : {l: 62, r: 14, b: 46}), t: coarse ? 8 : 38},
      legend: {
        orientation: 'h', x: 0, yref: 'container', y: 0, yanchor: 'bottom',
        groupclick: 'togglegroup', bgcolor: 'rgba(0,0,0,0)',
      },
      modebar: {
        bgcolor: 'rgba(0,0,0,0)', color: colour('soft'), activecolor: colour('accent'),
      },
      hoverlabel: {bgcolor: colour('panel'), font: {color: colour('text')}, namelength: -1},
      // Touching a figure scrolls the page.
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
  // A long legend makes its figure taller, not the plot smaller.
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
    // At first it may have been cut for lack of room.
    await grow(element, figure);
  };
  const figures = given.figures.map(figure => [document.getElementById(figure.key), figure]);
  const drawn = new Set();
  const show = ([element, figure]) => {
    if (drawn.has(element)) return;
    drawn.add(element);
    draw(element, figure);
  };
  // Figures far below are drawn when they come near.
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
        rows, row => Array.from(row.cells, value).join('\t')).join('\n'));
      const label = button.textContent;
      button.textContent = 'Copied';
      setTimeout(() => { button.textContent = label; }, 1500);
    });
  }
})();
