// The health of the services: one word in the head, a table when it is opened.
import { make, mark, the, write } from "./dom.js";
import { bytes, number, say } from "./words.js";

/** Show the services of a message `state` in the head, and in the table while that is open. */
export function showHealth(state) {
  const services = state.services ?? [];
  const bad = services.filter((one) => level(one) !== "good");
  const worst = bad.some((one) => level(one) === "bad") ? "bad" : bad.length ? "warn" : services.length ? "good" : "";
  const button = the("open-health");
  mark(button.querySelector(".dot"), "data-state", worst);
  mark(button, "data-state", worst);
  const names = bad.slice(0, 2).map((one) => one.service).join(", ") + (bad.length > 2 ? ", …" : "");
  write(button.querySelector(".value"), bad.length ? names : services.length ? say("health.well", { count: services.length }) : "–");
  mark(button, "aria-label", `${say("health.title")}: ${bad.length ? names : say("health.all_well")}`);
  if (!the("health").hidden) table(services, state.hosts ?? []);
}

function level(one) {
  if (one.alive === false) return "bad";
  return one.state === "ready" && !one.faults?.length ? "good" : "warn";
}

function table(services, hosts) {
  const panel = the("health");
  const rows = services.map((one) => [
    one.service,
    level(one),
    [one.alive === false ? say("health.dead") : one.state, one.text].filter(Boolean).join(": "),
    one.faults ?? [],
    `${number((one.cpu ?? 0) * 100, 0)} %`,
    bytes((one.rss_mb ?? 0) * 1e6),
  ]);
  const seen = JSON.stringify([rows, hosts, document.documentElement.lang]);
  if (panel.dataset.seen === seen) return;
  panel.dataset.seen = seen;
  const body = rows.map(([name, how, text, faults, cpu, memory]) =>
    make(
      "tr",
      {},
      make("td", {}, make("i", { class: "dot", "data-state": how, "aria-hidden": "true" }), name),
      make("td", {}, text, ...faults.map((fault) => make("span", { class: "fault" }, fault))),
      make("td", { class: "number" }, cpu),
      make("td", { class: "number" }, memory),
    ),
  );
  const heads = ["service", "state", "cpu", "memory"].map((name, index) => make("th", { scope: "col", class: index > 1 ? "number" : null }, say(`health.${name}`)));
  const parts = [make("table", {}, make("thead", {}, make("tr", {}, ...heads)), make("tbody", {}, ...body))];
  if (hosts.length) {
    const said = hosts.map((host) => (typeof host === "string" ? host : [host.host, host.state, host.text].filter(Boolean).join(" ")));
    parts.push(make("p", { class: "soft" }, `${say("health.hosts")}: ${said.join("; ")}`));
  }
  const head = panel.querySelector("header");
  panel.replaceChildren(...(head ? [head] : []), ...parts);
}
