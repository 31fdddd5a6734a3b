// Sliders over precomputed frames: <div class="frames" data-stem="gallery/focus_" data-count="13">
// holds an image (the first frame to be seen) and an <input type="range">.
document.addEventListener("DOMContentLoaded", () => {
  for (const frames of document.querySelectorAll(".frames")) {
    const image = frames.querySelector("img");
    const slider = frames.querySelector("input");
    const name = (k) => `${frames.dataset.stem}${String(k).padStart(2, "0")}.jpg`;
    const kept = [];
    for (let k = 0; k < Number(frames.dataset.count); k++) {
      kept[k] = new Image();
      kept[k].src = name(k);
    }
    slider.addEventListener("input", () => { image.src = name(slider.value); });
  }
});
