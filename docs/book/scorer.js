// The order of the search's results: chapters first, then the documentation, then the API.
var Scorer = {
  score: ([docname, , , , score]) => score + (docname.startsWith("notebooks/") ? 200 : docname.startsWith("api/") ? 0 : 100),
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
