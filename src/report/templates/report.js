// Source and pack, divided where the slider stands.
for (const slider of document.querySelectorAll('.compare input')) {
  slider.addEventListener('input', () => slider.closest('.compare').style.setProperty('--at', slider.value + '%'));
}
for (const button of document.querySelectorAll('.strip button')) {
  button.addEventListener('click', () => {
    const still = button.closest('.strip').classList.toggle('still');
    button.setAttribute('aria-pressed', still);
    button.textContent = still ? 'Play' : 'Pause';
  });
}
// Tables are sorted by the column whose heading is pressed; what has no number goes last.
for (const table of document.querySelectorAll('.sortable')) {
  const heads = [...table.querySelectorAll('thead th')];
  const body = table.tBodies[0];
  const sort = (column, ascending) => {
    const key = row => {
      const cell = row.cells[column];
      return cell === undefined ? -Infinity : column === 0 ? cell.textContent : parseFloat(cell.dataset.sort ?? 'NaN');
    };
    const order = (a, b) => {
      const [x, y] = [key(a), key(b)];
      if (typeof x === 'string') return x.localeCompare(y);
      // An exact pack has no PSNR: it is better than any number.
      return (Number.isNaN(x) ? Infinity : x) - (Number.isNaN(y) ? Infinity : y) || 0;
    };
    const rows = [...body.rows].sort(order);
    body.append(...(ascending ? rows : rows.reverse()));
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
