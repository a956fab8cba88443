#version 330
// An image, whose unknown texels get the mean of their known neighbours.
uniform sampler2D image;
uniform sampler2D known;  // w: 1 where the image is known, 0 elsewhere
out vec4 value;
void main() {
    ivec2 place = ivec2(gl_FragCoord.xy), last = textureSize(image, 0) - 1;
    value = texelFetch(image, place, 0);
    if (texelFetch(known, place, 0).w > 0.0) return;
    float count = 0.0;
    value = vec4(0.0);
    for (int y = max(place.y - 1, 0); y <= min(place.y + 1, last.y); y++) {
        for (int x = max(place.x - 1, 0); x <= min(place.x + 1, last.x); x++) {
            float weight = texelFetch(known, ivec2(x, y), 0).w;
            value += weight * texelFetch(image, ivec2(x, y), 0);
            count += weight;
        }
    }
    value /= max(count, 1.0);
}
