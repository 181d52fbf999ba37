for (const compare of document.querySelectorAll(".compare")) {
  const range = compare.querySelector("input");
  const place = () => compare.style.setProperty("--cut", range.value + "%");
  range.addEventListener("input", place);
  place();
}
const box = document.getElementById("lightbox");
const buttons = [...document.querySelectorAll(".enlarge")];
let shown = 0;
const show = (index) => {
  shown = (index + buttons.length) % buttons.length;
  const picture = buttons[shown].querySelector("img");
  const large = box.querySelector("img");
  large.src = picture.src;
  large.alt = picture.alt;
  box.querySelector("p").textContent = buttons[shown].dataset.caption;
};
buttons.forEach((button, index) => button.addEventListener("click", () => { show(index); box.showModal(); }));
box.addEventListener("click", () => box.close());
box.addEventListener("close", () => buttons[shown].focus());
box.addEventListener("keydown", (event) => {
  const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
  if (step) { event.preventDefault(); show(shown + step); }
});
