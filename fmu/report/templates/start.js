// What the script makes of a page that is whole without it.

for (const box of document.querySelectorAll(".view"))
  unpack(box.querySelector("script").textContent).then(model => new StructureView(box, model));
document.querySelectorAll("table").forEach(sortable);
document.querySelectorAll("figure.plot").forEach(enliven);
