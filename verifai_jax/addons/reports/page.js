(() => {
  const block = document.getElementById("table-view");
  const root = document.getElementById("explore");
  if (!block || !root) return;
  root.hidden = false;
  view(root, JSON.parse(block.textContent));
  document.getElementById("still").hidden = true;
})();
