for (const compare of document.querySelectorAll(".compare")) {
  const range = compare.querySelector("input");
  const place = () => compare.style.setProperty("--cut", range.value + "%");
  range.addEventListener("input", place);
  place();
}
const box = document.getElementById("lightbox");
for (const button of document.querySelectorAll(".enlarge")) {
  button.addEventListener("click", () => {
    const caption = button.parentElement.querySelector("figcaption");
    box.querySelector("img").src = button.querySelector("img").src;
    box.querySelector("p").textContent = caption ? caption.textContent.trim().replace(/\s+/g, " ") : "";
    box.showModal();
  });
}
box.addEventListener("click", () => box.close());
