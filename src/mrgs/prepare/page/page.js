const facts = JSON.parse(document.getElementById("page-facts").textContent);
setUpPairs();
setUpMeasure();
if (facts.orbit) {
  new Orbit(document.getElementById("orbit-canvas"), document.getElementById("orbit-name"), facts.orbit, showView);
}
