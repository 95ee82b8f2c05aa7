// The page: send a video, watch the job, look at the hand. Everything shown goes in as text, never as markup.
const $ = (id) => document.getElementById(id);
const POSES = ["rest", "fist", "point", "pinch", "spread"];
let current = null; // id of the job shown
let pose = "rest";
let timer = 0;
let pictures = 0; // asked for so far

const show = (id, on) => { $(id).hidden = !on; };
const minutes = (s) => (s < 90 ? `${Math.ceil(s)} s` : `${Math.ceil(s / 60)} min`);

function size(bytes) {
  const [unit, name] = bytes < 1e3 ? [1, "bytes"] : bytes < 1e6 ? [1e3, "kB"] : [1e6, "MB"];
  return `${Number((bytes / unit).toPrecision(3))} ${name}`;
}

function complain(problem) {
  show("problem", Boolean(problem));
  if (problem) $("problem").textContent = `${problem.detail || problem.message} ${problem.advice || ""}`;
}

// A service that asks for keys gets the one typed in, which this tab forgets when it is closed.
const auth = () => (sessionStorage.key ? { Authorization: `Bearer ${sessionStorage.key}` } : {});

async function ask(path, options) {
  const answer = await fetch(path, { ...options, headers: { ...options?.headers, ...auth() } });
  if (answer.ok) return answer;
  if (answer.status === 401) show("login", true);
  throw await answer.json();
}

async function call(path, options) {
  const answer = await ask(path, options);
  return answer.status === 204 ? null : answer.json();
}

async function save(job, name) { // an ordinary download, by a link that works for a minute
  const body = JSON.stringify({ target: `assets/${name}`, seconds: 60 });
  const headers = { "Content-Type": "application/json" };
  location.href = (await call(`/jobs/${job}/links`, { method: "POST", headers, body })).href;
}

function row(text, href, note) {
  const item = document.createElement("li");
  const link = Object.assign(document.createElement("a"), { href, textContent: text });
  item.append(link, Object.assign(document.createElement("small"), { textContent: note }));
  return item;
}

async function send(file) {
  const limits = await call("/capabilities");
  if (file.size > limits.max_upload_bytes) {
    return complain({ detail: "This file is too large.", advice: "Send a shorter video." });
  }
  complain(null);
  const form = new FormData();
  form.append("video", file);
  const request = new XMLHttpRequest(); // fetch cannot report how much was sent
  request.responseType = "json";
  request.upload.onprogress = (event) => progress("uploading", event.loaded / event.total, null, "");
  const refused = (problem) => { show("job", false); complain(problem); };
  request.onerror = () => refused({ detail: "The connection broke.", advice: "Send the video again." });
  request.onload = () => (request.status === 202 ? watch(request.response.id) : refused(request.response));
  request.open("POST", "/jobs");
  for (const [name, value] of Object.entries(auth())) request.setRequestHeader(name, value);
  request.send(form);
  clearTimeout(timer);
  current = null;
  show("result", false);
  show("preview", false);
  progress("uploading", 0, null, "");
}

function progress(state, fraction, left, message) {
  show("job", true);
  const over = fraction === null; // a job that is over is not so and so far
  $("state").textContent = over ? state : `${state} · ${Math.round(fraction * 100)} %`;
  $("left").textContent = left === null ? "" : `about ${minutes(left)} left`;
  show("bar", !over);
  $("bar").value = fraction;
  $("message").textContent = message;
  show("cancel", false);
  show("delete", false);
}

async function watch(id) {
  clearTimeout(timer);
  if (id !== current) show("preview", false);
  current = id;
  location.hash = id;
  let job;
  try {
    job = await call(`/jobs/${id}`);
  } catch (problem) {
    if (problem.code) { show("job", false); show("result", false); return complain(problem); }
    timer = setTimeout(() => watch(id), 3000); // the service is away; it may come back
    return complain({ detail: "The service does not answer.", advice: "Trying again." });
  }
  if (current !== id) return;
  complain(job.error);
  const label = job.state === "running" && job.stage ? job.stage : job.state;
  progress(label, job.links.cancel ? job.fraction : null, job.time_left, job.message);
  show("cancel", Boolean(job.links.cancel) && job.state !== "cancelling");
  show("delete", !job.links.cancel);
  show("result", Boolean(job.links.render));
  if (job.state === "running") look(job);
  else show("preview", false);
  if (job.links.cancel) timer = setTimeout(() => watch(id), 1000);
  else list();
  if (job.links.render) {
    const { assets } = await call(job.links.assets);
    const hands = ["right", "left"].filter((hand) => assets.some((a) => a.name.startsWith(`${hand}/`)));
    show("hands", hands.length === 2);
    picture();
    $("assets").replaceChildren(...assets.map((a) => {
      const item = row(a.name, a.href, size(a.bytes));
      item.firstChild.onclick = (event) => { event.preventDefault(); save(id, a.name).catch(complain); };
      return item;
    }));
  }
}

async function look(job) { // the hand as it is now; there is none before it is coloured
  const answer = await fetch(job.links.preview, { headers: auth() });
  if (!answer.ok || current !== job.id) return;
  URL.revokeObjectURL($("preview").src);
  $("preview").src = URL.createObjectURL(await answer.blob());
  show("preview", true);
}

async function picture() {
  const asked = ++pictures;
  const camera = `orbit:${$("yaw").value},${$("pitch").value}`;
  const query = new URLSearchParams({
    pose, camera, width: 512, height: 512, format: "png", channel: $("channel").value,
  });
  if (!$("hands").hidden) query.set("hand", $("hand").value);
  $("picture").classList.add("busy");
  for (const button of $("poses").children) button.setAttribute("aria-pressed", button.textContent === pose);
  try {
    const drawn = await (await ask(`/jobs/${current}/render?${query}`)).blob();
    if (asked !== pictures) return; // another one has been asked for since
    URL.revokeObjectURL($("picture").src);
    $("picture").src = URL.createObjectURL(drawn);
  } catch (problem) {
    if (asked !== pictures) return;
    $("picture").classList.remove("busy");
    complain(problem);
  }
}

async function list() {
  show("login", false);
  const { jobs } = await call("/jobs?limit=10");
  $("jobs").replaceChildren(...jobs.map((job) => row(new Date(job.created_at).toLocaleString(), `#${job.id}`, job.state)));
}

$("poses").append(...POSES.map((name) => {
  const button = Object.assign(document.createElement("button"), { textContent: name });
  button.onclick = () => { pose = name; picture(); };
  return button;
}));
$("picture").onload = $("picture").onerror = () => $("picture").classList.remove("busy");
$("yaw").onchange = $("pitch").onchange = $("channel").onchange = $("hand").onchange = picture;
$("file").onchange = (event) => event.target.files[0] && send(event.target.files[0]);
$("cancel").onclick = () => call(`/jobs/${current}/cancel`, { method: "POST" }).catch(complain);
$("delete").onclick = async () => {
  await call(`/jobs/${current}`, { method: "DELETE" }).catch(complain);
  current = null;
  history.replaceState(null, "", "/");
  show("job", false);
  show("result", false);
  list();
};
for (const [name, on] of [["dragover", true], ["dragleave", false], ["drop", false]]) {
  $("drop").addEventListener(name, (event) => {
    event.preventDefault();
    $("drop").classList.toggle("over", on);
    if (name === "drop" && event.dataTransfer.files[0]) send(event.dataTransfer.files[0]);
  });
}
window.onhashchange = () => { const id = location.hash.slice(1); if (id && id !== current) watch(id); };
$("login").onsubmit = (event) => {
  event.preventDefault();
  sessionStorage.key = $("key").value;
  list().then(() => complain(null), complain);
};
list().catch(complain);
if (location.hash) watch(location.hash.slice(1));
