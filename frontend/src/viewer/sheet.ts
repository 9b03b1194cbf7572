// The contact sheet: search and filters over cards that stand in the page already.
import "../shared/base.css";
import "./page.css";
import "./sheet.css";
import { find } from "../shared/element";
import { startTheme } from "../shared/theme";

const cards = [...document.querySelectorAll<HTMLElement>(".card")].map((element) => ({
  element,
  text: plain(`${element.textContent} ${element.dataset["cameras"] ?? ""}`),
  verdict: element.dataset["verdict"] ?? "",
  cameras: JSON.parse(element.dataset["cameras"] ?? "[]") as string[],
}));
const search = find<HTMLInputElement>("search");
const camera = find<HTMLSelectElement>("camera");
const verdict = find<HTMLSelectElement>("verdict");

startTheme(find<HTMLButtonElement>("theme"));
for (const input of [search, camera, verdict]) input.addEventListener("input", filter);
find("finder").addEventListener("submit", (event) => event.preventDefault());
find("clear").addEventListener("click", () => {
  search.value = camera.value = verdict.value = "";
  filter();
  search.focus();
});
addEventListener("keydown", (event) => {
  if (event.key !== "/" || event.target === search || event.ctrlKey || event.metaKey) return;
  event.preventDefault();
  search.focus();
});
filter();

function filter(): void {
  const words = plain(search.value).split(" ").filter(Boolean);
  let count = 0;
  for (const card of cards) {
    const fits =
      words.every((word) => card.text.includes(word)) &&
      (!camera.value || card.cameras.includes(camera.value)) &&
      (!verdict.value || card.verdict === verdict.value);
    card.element.hidden = !fits;
    if (fits) count++;
  }
  const all = cards.length === 1 ? "1 object" : `${cards.length} objects`;
  find("count").textContent = count === cards.length ? all : `${count} of ${all}`;
  find("nothing").hidden = count > 0;
}

/** Lower case without accents, single spaces. */
function plain(text: string): string {
  return text.normalize("NFKD").replace(/\p{M}/gu, "").toLowerCase().replace(/\s+/g, " ");
}
