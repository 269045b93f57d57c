/* Stands in for DJI's library: the same functions, and temperatures that show what was passed to them. */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

typedef struct { int32_t width, height; } resolution_t;
typedef struct {
  float distance, humidity, emissivity, reflection;
#ifdef WITH_AIR
  float ambient;
#endif
} params_t;
typedef struct { params_t params; int32_t size; } image_t;

int32_t dirp_create_from_rjpeg(const uint8_t *data, int32_t size, void **handle) {
  if (size < 4 || data[0] != 0xFF || data[1] != 0xD8) return -7;
  image_t *image = calloc(1, sizeof *image);
  image->params.distance = 5.0f;
  image->params.humidity = 70.0f;
  image->params.emissivity = 1.0f;
  image->params.reflection = 23.0f;
#ifdef WITH_AIR
  image->params.ambient = 25.0f;
#endif
  image->size = size;
  *handle = image;
  return 0;
}

int32_t dirp_get_rjpeg_resolution(void *handle, resolution_t *out) {
  (void)handle;
#ifdef HUGE_SIZE
  out->width = 30000;
#else
  out->width = 4;
#endif
  out->height = 3;
  return 0;
}

int32_t dirp_get_measurement_params(void *handle, params_t *out) {
  memcpy(out, &((image_t *)handle)->params, sizeof *out);
  return 0;
}

int32_t dirp_set_measurement_params(void *handle, const params_t *in) {
  if (in->distance < 1.0f || in->distance > 25.0f || in->humidity < 20.0f || in->humidity > 100.0f) return -3;
  memcpy(&((image_t *)handle)->params, in, sizeof *in);
  return 0;
}

int32_t dirp_measure_ex(void *handle, float *out, int32_t size) {
  image_t *image = handle;
  if (size != 4 * 3 * (int32_t)sizeof(float)) return -8;
  for (int i = 0; i < 12; i++) out[i] = (float)i;
  out[0] = image->params.distance;
  out[1] = image->params.humidity;
  out[2] = image->params.emissivity;
  out[3] = image->params.reflection;
#ifdef WITH_AIR
  out[4] = image->params.ambient;
#endif
  out[11] = NAN;
  return 0;
}

int32_t dirp_destroy(void *handle) {
  free(handle);
  return 0;
}
