"use strict";
// Buttons that copy the text below them; where a browser forbids that, they select it.
for (const button of document.querySelectorAll("button.copy")) {
  const text = button.nextElementSibling, label = button.textContent;

  function selected() {
    const range = document.createRange();
    range.selectNodeContents(text);
    getSelection().removeAllRanges();
    getSelection().addRange(range);
    return document.execCommand("copy");
  }

  button.addEventListener("click", async () => {
    const copied = await navigator.clipboard?.writeText(text.textContent).then(() => true, () => false);
    button.textContent = copied || selected() ? "Copied" : "Selected: press Ctrl+C";
    setTimeout(() => { button.textContent = label; }, 2000);
  });
}
