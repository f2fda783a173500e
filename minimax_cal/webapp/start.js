"use strict";
// Begins a session.
document.getElementById("begin").addEventListener("submit", async (event) => {
  event.preventDefault();
  const problem = document.getElementById("problem");
  try {
    const title = document.getElementById("title").value;
    const answer = await fetch("/sessions", { method: "POST", body: JSON.stringify({ title }) });
    const content = await answer.json();
    if (answer.ok) location.href = `/s/${content.name}`;
    problem.textContent = content.error ?? "";
  } catch {
    problem.textContent = "The server does not answer: is minimax-cal serve still running?";
  }
  problem.hidden = !problem.textContent;
});
