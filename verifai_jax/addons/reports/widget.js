export default {
  render({ model, el }) {
    const root = document.createElement("div");
    el.append(root);
    const shown = view(root, model.get("data"), (row) => model.send({ row }));
    model.on("msg:custom", (message) => shown.answer(message.row, message.trace));
  },
};
