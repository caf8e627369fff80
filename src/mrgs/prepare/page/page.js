const facts = JSON.parse(document.getElementById("page-facts").textContent);
setUpPairs();
setUpMeasure();
if (facts.orbit) setUpWorld(facts.orbit);
