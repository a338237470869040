'use strict';
(() => {
  const figures = new Map(JSON.parse(document.getElementById('report-data').textContent).map(
    figure => [document.getElementById(figure.key), figure]));
  const show = element => {
    if (!figures.has(element)) return;
    drawFigure(element, figures.get(element));
    figures.delete(element);
  };
  // Figures far below are drawn when they come near.
  const watcher = new IntersectionObserver(entries => {
    for (const entry of entries) if (entry.isIntersecting) show(entry.target);
  }, {rootMargin: '800px'});
  for (const element of figures.keys()) watcher.observe(element);
  window.addEventListener('beforeprint', () => [...figures.keys()].forEach(show));

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
  for (const button of document.querySelectorAll('button[data-columns]')) {
    button.addEventListener('click', () => {
      const all = document.getElementById(button.dataset.columns).classList.toggle('all');
      button.setAttribute('aria-expanded', all);
      button.textContent = all ? 'Fewer columns' : 'All columns';
    });
  }
})();
