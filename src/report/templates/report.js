// Source and pack, divided where the slider stands.
for (const slider of document.querySelectorAll('.compare input')) {
  slider.addEventListener('input', () => slider.closest('.compare').style.setProperty('--at', slider.value + '%'));
}
for (const button of document.querySelectorAll('.strip button')) {
  const strip = button.closest('.strip');
  const hold = still => {
    strip.classList.toggle('still', still);
    button.textContent = still ? 'Play' : 'Pause';
  };
  hold(matchMedia('(prefers-reduced-motion: reduce)').matches);
  button.addEventListener('click', () => hold(!strip.classList.contains('still')));
}
// Tables are sorted by the column whose heading is pressed; what has no number goes last, either way.
for (const table of document.querySelectorAll('.sortable')) {
  const heads = [...table.querySelectorAll('thead th')];
  const body = table.tBodies[0];
  const sort = (column, ascending) => {
    const sign = ascending ? 1 : -1;
    const name = row => row.cells[0].textContent;
    const number = row => parseFloat(row.cells[column]?.dataset.sort);
    const order = (a, b) => {
      if (column === 0) return sign * name(a).localeCompare(name(b));
      const [x, y] = [number(a), number(b)];
      if (Number.isNaN(x) || Number.isNaN(y)) return Number.isNaN(x) - Number.isNaN(y);
      return x === y ? 0 : sign * (x < y ? -1 : 1);
    };
    body.append(...[...body.rows].sort(order));
    heads.forEach((head, i) => head.setAttribute('aria-sort', i === column ? (ascending ? 'ascending' : 'descending') : 'none'));
  };
  heads.forEach((head, column) => {
    const button = document.createElement('button');
    button.type = 'button';
    button.textContent = head.textContent;
    head.replaceChildren(button);
    button.addEventListener('click', () => sort(column, head.getAttribute('aria-sort') === 'descending'));
  });
  sort(1, false);
}
