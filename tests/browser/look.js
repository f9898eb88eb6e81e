// Opens a page in a browser that is installed and tells what it finds, as JSON:
//   node look.js PAGE.html [FOLDER_OF_SCREENSHOTS]
// Errors on the console, requests, figures and their sizes, faults of accessibility, and whether
// the page is wider than its window, on a light desk and on a dark phone. No style depends on both
// the width and the scheme (a test reads them), so that these two show what four would.
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { join, resolve } from "node:path";
import { pathToFileURL } from "node:url";
import puppeteer from "puppeteer-core";

const require = createRequire(import.meta.url);
const axe = readFileSync(require.resolve("axe-core/axe.min.js"), "utf8");
const [page_path, folder] = process.argv.slice(2);
const address = pathToFileURL(resolve(page_path)).href;

const WINDOWS = [
  { name: "desk", scheme: "light", width: 1280, height: 900 },
  { name: "phone", scheme: "dark", width: 390, height: 844 },
];

function figures() {
  // Whether a pointer over the first value of a figure meets that value, and nothing above it.
  function hovered(svg) {
    const part = svg.querySelector(".hover title")?.parentElement;
    if (!part) return null;
    part.scrollIntoView({ block: "center" });
    const box = part.getBoundingClientRect();
    const at = document.elementFromPoint(box.left + box.width / 2, box.top + box.height / 2);
    return Boolean(at?.closest(".hover")?.querySelector("title"));
  }
  return [...document.querySelectorAll("figure svg")].map((svg) => {
    const box = svg.getBoundingClientRect();
    const drawn = svg.querySelectorAll("path, image, use").length;
    const visible = svg.checkVisibility({ opacityProperty: true, visibilityProperty: true });
    const inside = box.left >= 0 && box.right <= window.innerWidth + 1;
    const values = svg.querySelectorAll(".hover title").length;
    return { alt: svg.getAttribute("aria-label"), width: box.width, height: box.height, drawn, visible, inside, values, hovered: hovered(svg) };
  });
}

// Smallest text on the page as it is seen, figures included: their text scales with them.
function smallest_text() {
  return Math.min(
    ...[...document.querySelectorAll("figure svg text")].map((text) => {
      const svg = text.ownerSVGElement;
      const scale = svg.getBoundingClientRect().width / svg.viewBox.baseVal.width;
      return parseFloat(getComputedStyle(text).fontSize) * scale;
    }),
  );
}

// What is inside of a figure is one picture with one name: axe-core would read thousands of parts.
function empty_figures() {
  document.querySelectorAll("figure svg").forEach((each) => each.replaceChildren());
}

async function look(browser, { name, scheme, ...size }) {
  const page = await browser.newPage();
  const found = { window: name, scheme, errors: [], requests: [] };
  page.on("console", (message) => {
    if (["error", "warn"].includes(message.type())) found.errors.push(message.text());
  });
  page.on("pageerror", (error) => found.errors.push(String(error)));
  page.on("request", (request) => {
    const url = request.url();
    if (url !== address && !url.startsWith("data:")) found.requests.push(url);
  });
  page.on("dialog", async (dialog) => {
    found.errors.push(`dialog: ${dialog.message()}`);
    await dialog.dismiss();
  });
  await page.setViewport(size);
  await page.emulateMediaFeatures([{ name: "prefers-color-scheme", value: scheme }]);
  await page.goto(address, { waitUntil: "networkidle0" });
  found.figures = await page.evaluate(figures);
  found.smallest_text = await page.evaluate(smallest_text);
  found.wider = await page.evaluate(
    () => document.documentElement.scrollWidth > document.documentElement.clientWidth,
  );
  found.cut = await page.evaluate(() =>
    [...document.querySelectorAll(".card .scroll")]
      .filter((each) => each.scrollWidth > each.clientWidth + 1)
      .map((each) => each.getAttribute("aria-label")),
  );
  found.background = await page.evaluate(() => getComputedStyle(document.body).backgroundColor);
  found.text = await page.evaluate(() => document.body.innerText);
  found.title = await page.title();
  if (folder) await page.screenshot({ path: join(folder, `${name}.png`), fullPage: true });
  await page.evaluate(empty_figures);
  await page.evaluate(() => document.querySelectorAll("details").forEach((each) => (each.open = true)));
  // Runs outside of the page's policy, which allows no script.
  const world = await page.createCDPSession();
  const { frameTree } = await world.send("Page.getFrameTree");
  const { executionContextId } = await world.send("Page.createIsolatedWorld", {
    frameId: frameTree.frame.id,
    worldName: "axe",
  });
  await world.send("Runtime.evaluate", { expression: axe, contextId: executionContextId });
  const { result } = await world.send("Runtime.evaluate", {
    expression:
      "axe.run().then((r) => JSON.stringify(r.violations.map((v) => " +
      "({ id: v.id, impact: v.impact, help: v.help, nodes: v.nodes.map((n) => n.html.slice(0, 200)) }))))",
    contextId: executionContextId,
    awaitPromise: true,
    returnByValue: true,
  });
  found.accessibility = JSON.parse(result.value);
  await page.close();
  return found;
}

// Tab from the top: which elements get the focus, in order.
async function tabbed(browser) {
  const page = await browser.newPage();
  await page.setViewport({ width: 1280, height: 900 });
  await page.goto(address);
  const stops = [];
  for (let k = 0; k < 24; k += 1) {
    await page.keyboard.press("Tab");
    if (await page.evaluate(() => document.activeElement === document.body)) break; // all were seen
    stops.push(
      await page.evaluate(() => {
        const at = document.activeElement;
        return { name: at.innerText || at.getAttribute("aria-label"), outline: getComputedStyle(at).outlineStyle };
      }),
    );
  }
  await page.close();
  return stops;
}

const browser = await puppeteer.launch({
  executablePath: process.env.L2M_BROWSER,
  args: ["--no-sandbox", "--disable-gpu"],
});
const found = { looks: [] };
for (const window_ of WINDOWS) found.looks.push(await look(browser, window_));
found.tabbed = await tabbed(browser);
await browser.close();
process.stdout.write(JSON.stringify(found));
