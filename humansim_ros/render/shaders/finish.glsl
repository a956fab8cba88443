// What surfaces do with light besides their colour, by appendix B of the specification of glTF 2.0. Light is in units of
// what a white matt surface that faces it shows: pi is in them already.
uniform vec3 eye;
uniform float shines;      // 0: matt, and all below means nothing
uniform float metallic, roughness, bump, cutoff, opacity;
uniform vec3 specular;      // reflectance of non-metals at normal incidence (F0)
uniform vec3 emission;
uniform float brightness;  // of a light of 1
uniform bool one_sided, masked;
uniform sampler2D metal_rough, normal_map, glow, cut;
uniform float sharpest;    // of what shines: as wide as the sun
float opaqueness(vec2 uv) { return opacity * texture(cut, uv).r; }
// the normal that a map says, its axes found by how place and coordinates change across the picture (C. Schueler 2013)
vec3 bumped(vec3 n, vec3 place, vec2 uv) {
    if (bump == 0.0) return n;
    vec3 px = dFdx(place), py = dFdy(place);
    vec2 tx = dFdx(uv), ty = dFdy(uv);
    vec3 nx = cross(n, px), ny = cross(py, n);
    vec3 t = ny * tx.x + nx * ty.x, b = ny * tx.y + nx * ty.y;
    float size = max(dot(t, t), dot(b, b)), turned = dot(n, cross(px, py)) < 0.0 ? -1.0 : 1.0;
    vec3 m = texture(normal_map, uv).xyz * (255.0 / 127.5) - 1.0;
    m.xy *= bump * turned;
    if (size == 0.0) return n;
    return normalize((t * m.x + b * m.y) * inversesqrt(size) + n * m.z);
}
vec3 fresnel(vec3 straight, float slant) { return straight + (1.0 - straight) * pow(1.0 - slant, 5.0); }
// J. Lazarov's and B. Karis' fit of what of even light a surface throws back: times what it does straight on, and besides
vec2 mirrored_of_even(float rough, float nv) {
    vec4 r = rough * vec4(-1.0, -0.0275, -0.572, 0.022) + vec4(1.0, 0.0425, 1.04, -0.04);
    return vec2(-1.04, 1.04) * (min(r.x * r.x, exp2(-9.28 * nv)) * r.x + r.y) + r.zw;
}
vec3 finished(vec3 albedo, vec3 n, vec3 place, vec2 uv, vec3 around, vec3 sky, vec3 ground, vec3 sun, vec3 sunlight) {
    vec3 v = normalize(eye - place), h = normalize(v + sun), given = texture(metal_rough, uv).rgb;
    float rough = clamp(roughness * given.g, 0.0, 1.0), metal = clamp(metallic * given.b, 0.0, 1.0);
    vec3 inside = albedo * (1.0 - metal), straight = mix(specular, albedo, metal);
    float nv = max(dot(n, v), 1e-3), nl = max(dot(n, sun), 0.0), nh = max(dot(n, h), 0.0);
    float a = max(rough * rough, sharpest), a2 = a * a, d = nh * nh * (a2 - 1.0) + 1.0;
    vec3 f = fresnel(straight, max(dot(v, h), 0.0));
    float seen = 0.5 / max(nl * sqrt(nv * nv * (1.0 - a2) + a2) + nv * sqrt(nl * nl * (1.0 - a2) + a2), 1e-6);
    vec3 light = sunlight * nl * ((1.0 - fresnel(specular, max(dot(v, h), 0.0))) * inside + f * (a2 / (d * d) * seen));
    // of sky and ground, the rougher the wider apart they blend into each other
    float up = reflect(-v, n).z, width = mix(0.05, 1.0, rough);
    vec2 even = mirrored_of_even(rough, nv);
    vec3 thrown = straight * even.x + even.y, open = mix(ground, sky, 0.5 + 0.5 * n.z);
    vec3 hidden = around / max(open, 1e-6);
    light += inside * (1.0 - specular * even.x - even.y) * around;
    light += thrown * mix(ground, sky, clamp(0.5 + 0.5 * up / width, 0.0, 1.0)) * hidden;
    vec3 own = texture(glow, uv).rgb;
    return light + brightness * emission * own * own;
}
