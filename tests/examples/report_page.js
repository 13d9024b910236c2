// What report_page.sh adds to the page about a flight: says in attributes of <html> what can be seen of it
// and how it answers to a wheel, a pointer and a press.
"use strict";

// How many of a canvas's pixels have nearly one of these colours. Of a plot, without the numbers at its
// axis and the bar below.
function pixels(canvas, colours) {
  const skipped = canvas === sceneCanvas ? 0 : left + 2, wanted = colours.map(colour => d3.rgb(colour));
  const copy = document.createElement("canvas"), context = copy.getContext("2d");
  copy.width = canvas.width - skipped;
  copy.height = canvas.height - (skipped ? 8 : 0);
  context.fillStyle = "#FFFFFF";
  context.fillRect(0, 0, copy.width, copy.height);
  context.drawImage(canvas, -skipped, 0);
  const data = context.getImageData(0, 0, copy.width, copy.height).data;
  const near = (colour, i) =>
    d3.sum([colour.r, colour.g, colour.b], (value, k) => Math.abs(value - data[i + k])) < 60;
  let count = 0;
  for (let i = 0; i < data.length; i += 4) if (wanted.some(colour => near(colour, i))) ++count;
  return count;
}
const seen = plots.filter(plot => pixels(plot.canvas, plot.series.map(s => s.colour)) > 100).length;
drawScene();
const way = sceneCanvas && pixels(sceneCanvas, [orange, purple, blue, green, red]) > 300;
document.documentElement.dataset.drawn = `plots ${seen} scene ${way ? 1 : 0} phases ${
  document.querySelectorAll("#phases button").length} figures ${
  [...document.querySelectorAll("#figures td:nth-child(2), #figures td:nth-child(3)")]
    .filter(cell => cell.textContent).length}`;

const answers = [], at = place.node().getBoundingClientRect();
const send = (target, event) => target.dispatchEvent(event);
const mouse = (type, x, y) => new MouseEvent(type, { clientX: x, clientY: y, bubbles: true, cancelable: true });
const shown = () => x.domain()[1] - x.domain()[0];
const wheel = ctrlKey => new WheelEvent("wheel",
  { deltaY: -300, ctrlKey, clientX: at.left + 300, clientY: at.top + 200, cancelable: true });
const flown = shown();
send(place.node(), wheel(false));
if (shown() === flown) answers.push("scroll");  // the page, not the plots
send(place.node(), wheel(true));
if (shown() < 0.9 * flown) answers.push("zoom");
send(document.querySelectorAll("#phases button")[1], mouse("click", 0, 0));
const phase = [time[phases[1].first], time[phases[1].last]];
if (phase.every((bound, i) => Math.abs(x.domain()[i] - bound) < 1e-6)) answers.push("phase");
drawPlots();
send(place.node(), new PointerEvent("pointermove", { clientX: at.left + left + 50, clientY: at.top + 200 }));
drawNow();
if (now > phase[0] && now < phase[1] && +element("time").value === +now.toFixed(2)) answers.push("time");
if (sceneCanvas) {
  const before = sceneCanvas.toDataURL();
  send(sceneCanvas, mouse("mousedown", 200, 300));
  send(document, mouse("mousemove", 300, 320));
  send(document, mouse("mouseup", 300, 320));
  drawScene();
  if (sceneCanvas.toDataURL() !== before) answers.push("turn");
}
document.documentElement.dataset.answers = answers.join(" ");
