// Sorts the fleet's table with the keyboard and tells what it shows then, as JSON:
//   node sort.js PAGE.html COLUMN...
import { resolve } from "node:path";
import { pathToFileURL } from "node:url";
import puppeteer from "puppeteer-core";

const [page_path, ...columns] = process.argv.slice(2);

// In the page: the state of a column, of how many others, and the text of its cells.
function shown(name) {
  const headers = [...document.querySelectorAll("table.sortable thead th")];
  const header = headers.find((each) => each.innerText.startsWith(name));
  const rows = [...header.closest("table").tBodies[0].rows];
  return {
    sort: header.getAttribute("aria-sort"),
    others: headers.filter((each) => each !== header && each.hasAttribute("aria-sort")).length,
    cells: rows.map((row) => row.cells[header.cellIndex].innerText.trim()),
  };
}

function focus(name) {
  const buttons = [...document.querySelectorAll("table.sortable thead button")];
  buttons.find((each) => each.innerText.startsWith(name)).focus();
}

const browser = await puppeteer.launch({
  executablePath: process.env.L2M_BROWSER,
  args: ["--no-sandbox", "--disable-gpu"],
});
const page = await browser.newPage();
const found = { errors: [], presses: [] };
page.on("console", (message) => {
  if (["error", "warn"].includes(message.type())) found.errors.push(message.text());
});
page.on("pageerror", (error) => found.errors.push(String(error)));
page.on("dialog", async (dialog) => {
  found.errors.push(`dialog: ${dialog.message()}`);
  await dialog.dismiss();
});
await page.goto(pathToFileURL(resolve(page_path)).href);
for (const column of columns) {
  await page.evaluate(focus, column);
  await page.keyboard.press("Enter");
  found.presses.push(await page.evaluate(shown, column));
}
await browser.close();
process.stdout.write(JSON.stringify(found));
