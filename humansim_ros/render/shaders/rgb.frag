#version 330
// Lit colour. Light is added in linear space; x * x and sqrt(x) stand for the sRGB curve and its inverse.
in vec3 v_normal;
in vec3 v_position;
in vec2 v_uv;
in vec3 v_color;
uniform sampler2D surface;
uniform vec3 eye;
uniform vec3 sun;        // direction to the light
uniform vec3 sun_color;
uniform vec3 sky_color;  // from above
uniform vec3 ground_color;
out vec4 rgb;
void main() {
    vec3 n = normalize(v_normal);
    if (dot(n, eye - v_position) < 0.0) n = -n;
    vec3 albedo = texture(surface, v_uv).rgb * v_color;
    albedo *= albedo;
    vec3 light = mix(ground_color, sky_color, 0.5 + 0.5 * n.z) + sun_color * max(dot(n, sun), 0.0);
    rgb = vec4(sqrt(albedo * light), 1.0);
}
