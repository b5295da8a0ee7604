// A headless Chromium, as Debian packages it.
import { existsSync } from "node:fs";
import { chromium } from "playwright-core";

const PLACES = [process.env.MULTISTAGE_CHROMIUM, "/usr/bin/chromium", "/usr/bin/chromium-browser", "/usr/bin/google-chrome"];

/** Why the browser tests can't run here, or false; as the `skip` option of a test. */
export const noBrowser = PLACES.some((place) => place && existsSync(place)) ? false : "no chromium: install the Debian package 'chromium'";

export function openBrowser() {
  return chromium.launch({
    executablePath: PLACES.find((place) => place && existsSync(place)),
    headless: true,
    args: ["--headless", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
  });
}

/** A page that fails the test at its end when anything went wrong that a person would only see in the console. */
export async function openPage(browser, url, options = {}) {
  const page = await browser.newPage({ viewport: { width: 1280, height: 900 }, ...options });
  const errors = [];
  page.on("pageerror", (error) => errors.push(String(error)));
  page.on("console", (message) => {
    if (/Content.Security.Policy/i.test(message.text()) || (message.type() === "error" && !/Failed to load resource/.test(message.text()))) errors.push(message.text());
  });
  await page.goto(url);
  return { page, errors };
}

/** How many colours a part of the page shows, from its screenshot. */
export async function distinctColours(page, locator) {
  const png = (await locator.screenshot()).toString("base64");
  return coloursOf(page, `data:image/png;base64,${png}`);
}

/** How many colours a canvas has in the very frame in which its height changes, after those that observe it were told. */
export async function coloursOnResize(page, canvas, height) {
  const png = await canvas.evaluate((shown, to) => new Promise((resolve) => {
    const before = shown.clientHeight;
    new ResizeObserver((_, observer) => {
      if (shown.clientHeight === before) return;
      observer.disconnect();
      resolve(shown.toDataURL());
    }).observe(shown);
    shown.style.height = `${to}px`;
  }), height);
  return coloursOf(page, png);
}

/** The number of colours of a PNG, a data URL; counted in the page, which can decode it. */
function coloursOf(page, png) {
  return page.evaluate(async (url) => {
    const image = new Image();
    image.src = url;
    await image.decode();
    const canvas = document.createElement("canvas");
    canvas.width = image.width;
    canvas.height = image.height;
    const context = canvas.getContext("2d");
    context.drawImage(image, 0, 0);
    return new Set(new Uint32Array(context.getImageData(0, 0, image.width, image.height).data.buffer)).size;
  }, png);
}
